"""Cost of plans: means and maxima over time of expressions, over any array library."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.ir import nodes as ir
from stlc.compile.namespace import Array, Ops
from stlc.compile.semantics.switch import Switch
from stlc.dynamics.declaration.learning import START

REDUCED = ir.Signal("#reduced")

HELD = 0.5
"""Magnitude of a status below which the goal is pending."""


@dataclass(frozen=True, slots=True)
class CostTerm:
    """Summand of a plan's cost: an expression, averaged or maximised over samples.

    The expression `number` is evaluated at each sample. The mean or maximum of its values is called
    `REDUCED`. The summand is the expression `value`, which may use `REDUCED`.

    Attributes:
        number: expression that is evaluated at each sample. It may use the states, the states at the first
            sample (name with suffix `START`), the index `k` and time `t` of the sample, the robustness `rho`
            of the plan, and the flag `sat` (1: the plan counts as satisfying).
        controlled: whether it also uses controls; it is then evaluated at the T steps of the plan, otherwise
            at all T+1 samples.
        greatest: True if `REDUCED` is the maximum of `number` over the samples, False if it is the mean.
        value: the summand, an expression of `REDUCED`, `rho`, `sat` and the states at the first sample.
    """

    number: ir.Num
    controlled: bool = False
    greatest: bool = False
    value: ir.Num = REDUCED


class PlanCost:
    """Sum of cost terms as a function of states, controls and robustness.

    Attributes:
        terms: the terms.
        dt: time step in seconds.
        controlled: whether a term uses controls.
    """

    def __init__(self, terms: Sequence[CostTerm], dt: float) -> None:
        self.terms, self.dt = tuple(terms), dt
        self.controlled = any(term.controlled for term in terms)
        self._programs = [
            (
                term,
                ArrayProgram({"number": term.number}),
                None if term.value == REDUCED else ArrayProgram({"value": term.value}),
            )
            for term in terms
        ]

    def with_mean(self, number: ir.Num | None, weight: float = 1.0, *, controlled: bool = False) -> PlanCost:
        """Add `weight` times the mean over time of an expression; nothing for None."""
        if number is None:
            return self
        value = REDUCED if weight == 1.0 else ir.Const(weight) * REDUCED
        return self._with(CostTerm(number, controlled=controlled, value=value))

    def with_shortfall(self, gamma: float, weight: float) -> PlanCost:
        """Add `weight` times what the robustness is below gamma, at most gamma."""
        rho = ir.Signal("rho")
        return self._with(CostTerm(rho, greatest=True, value=_lack(gamma, weight)))

    def with_goal(
        self,
        margin: ir.Num,
        clock: str,
        times: tuple[float, float],
        status: str,
        gamma: float,
        weight: float,
    ) -> PlanCost:
        """Add `weight` times the margin that plans lack at a goal, if it is pending at the first sample.

        A plan lacks gamma minus the largest margin that it reaches at the goal, from 0 to gamma.

        Args:
            margin: robustness at a sample.
            clock: name of the state that counts steps.
            times: least and greatest value of the clock at which the margin counts.
            status: name of the state that records the status of the goal; near 0 while it is pending.
            gamma: margin that plans should have.
            weight: factor.
        """
        since = ir.Predicate(ir.Signal(clock) - times[0])
        until = ir.Predicate(ir.Const(times[1]) - ir.Signal(clock))
        counted = (since & until).select(margin, -math.inf)
        size = ir.Signal(status + START).apply("abs")
        pending = ir.Predicate(ir.Const(HELD) - size, strict=True)
        value = pending.select(_lack(gamma, weight), 0.0)
        return self._with(CostTerm(counted, greatest=True, value=value))

    def _with(self, term: CostTerm) -> PlanCost:
        return PlanCost((*self.terms, term), self.dt)

    def __call__(
        self,
        states: Mapping[str, Array],
        controls: Mapping[str, Array],
        sat: Array,
        rho: Array,
        ops: Ops,
        switch: Switch | None = None,
    ) -> Array:
        """Return the cost, (1, B).

        Args:
            states: name of a state -> (T+1, B).
            controls: name of a control -> (T, B); may be empty if no term uses controls.
            sat: 1 where the plan counts as satisfying, else 0, (1, B).
            rho: robustness, (1, B).
            ops: the array library.
            switch: exact or smooth indicators `ind(…)`; None: exact ones.
        """
        found = []
        for term, number, value in self._programs:
            samples, read = len(next(iter(states.values()))) - term.controlled, number.columns
            starts = {name for name in (read | value.columns if value else read) if name.endswith(START)}
            once = {"sat": sat, "rho": rho} | {name: states[name.removesuffix(START)][:1] for name in starts}
            now = once | {name: states[name][:samples] for name in read & states.keys()}
            if read & {"k", "t"}:
                k = ops.counted(0, samples, rho)
                now |= {"k": k, "t": k * self.dt}
            if term.controlled:
                now |= controls
            each = number(now, ops, switch)["number"]
            total = ops.amax(each) if term.greatest else ops.sum(ops.repeat(each, samples)) / samples
            if value is not None:
                total = value({**once, REDUCED.name: total}, ops, switch)["value"]
            found.append(total)
        return reduce(ops.add, found) if found else ops.full(tuple(rho.shape), 0.0, rho)


def _lack(gamma: float, weight: float) -> ir.Num:
    """`weight` times what `REDUCED` is below gamma, at most gamma."""
    lack = (ir.Const(gamma) - REDUCED).apply("clip", 0.0, gamma)
    return ir.Const(weight) * lack
