"""Phases: short plans that reach a target while all safety requirements hold.

A phase is found by the local search of the native kernel, on the robustness of `safe until[0, L] target`. One
kernel serves all targets of a task. Further states, constant along a phase, say which target is asked for and
at which samples it counts.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from stlc.compile.backends.c.emit import LANES, emit
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import joined
from stlc.compile.ir.support import columns
from stlc.compile.ir.traverse import map_children, nodes
from stlc.compile.lowering.simplify import simplify
from stlc.controller.problem.native import motion_of
from stlc.native import Kernel, SearchOptions, Sizes, load

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from stlc.dynamics.model.system import System

    Numbers = NDArray[np.float64]

TARGET, FIRST, LAST = "#target", "#first", "#last"
OPEN, WEIGHT = "#open{}", "#weight{}"
WEIGHTS = 4
"""Number of groups of predicates whose shortfalls are weighed differently in different plans."""
GENERATIONS = 16
"""Generations of a local search in a round of the search for a phase."""
CLIMBED = 5
"""Number of plans that it improves."""
KEPT = 3
"""Number of plans that are kept from a round to the next."""
MOST_HELD = 81
"""Largest number of constant plans that the search for a phase may switch to."""
ROUNDS = 4
"""Rounds of the search for a phase: all plans with one more switch, then a local search from the best."""
SPREAD = 1.5
"""Standard deviation of the logarithm of the weights of shortfalls."""
SPARE = 1e-6
"""Margin that a strict predicate shall have."""
SHORTER = 0.7, 0.85
"""Shares of its length in which a phase that was found is tried again, until it fails in each."""


@dataclass(frozen=True, slots=True)
class Ask:
    """A request for a phase.

    Attributes:
        target: index of the target.
        first: first sample at which the target counts.
        last: last sample at which the target counts.
        open: indices of the `until`s whose left side must hold.
    """

    target: int
    first: int
    last: int
    open: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class Phase:
    """A phase.

    Attributes:
        plan: controls, (L, m).
        states: states of the system along them, (L + 1, n).
        sample: sample at which the target is reached or, if it is not, at which it is nearest.
        margin: robustness of the target there, with the safety up to there; negative if it is not reached.
    """

    plan: Numbers
    states: Numbers
    sample: int
    margin: float


class Phases:
    """Search for phases of one task, in compiled code.

    Args:
        kernel: the compiled code.
        system: system of the task.
        steps: number of steps of a phase, L.
        untils: number of `until`s of which a request names the open ones.
    """

    def __init__(self, kernel: Kernel, system: System, steps: int, untils: int) -> None:
        self._kernel, self.steps, self._untils = kernel, steps, untils
        low, high = (end.double().numpy() for end in (system.control_low, system.control_high))
        turns = np.array([float(control.squash == "angle") for control in system.decl.controls])
        self._bounds = np.stack((low, high, turns))
        self._middle = 0.5 * (low + high)
        held = levels(low, self._middle, high, most=MOST_HELD)
        self._bank = np.repeat(held[:, None], steps, 1)
        self.tried = 0

    @classmethod
    def of(
        cls,
        system: System,
        safe: ir.Formula,
        targets: Sequence[ir.Formula],
        late: Collection[int],
        untils: Sequence[ir.Formula],
        steps: int,
        scale: Callable[[ir.Formula], float],
    ) -> Phases | None:
        """Build the search; None without a compiler or a C form of the formulas.

        Args:
            system: system of the task.
            safe: formula that holds at every sample of a phase.
            targets: formulas, one of which a request asks for; they look less than `steps` samples ahead.
            late: indices of the targets after which one more sample must be safe.
            untils: formulas that hold at every sample of a phase while they are open.
            steps: number of steps of a phase.
            scale: function that returns the typical size of the margin of a predicate.
        """
        motion = motion_of(system)
        weights = (WEIGHT.format(i) for i in range(WEIGHTS))
        added = (TARGET, FIRST, LAST, *weights, *(OPEN.format(i) for i in range(len(untils))))
        motion = replace(motion, states=(*motion.states, *added), steps=steps)
        kept = (
            ir.BoolOp("or", (_equal(ir.Signal(OPEN.format(i)), 0.0), each)) for i, each in enumerate(untils)
        )
        shortfall = _Shortfall(scale)
        held = _decisive(joined("and", (safe, *kept), ir.Truth(True)))
        chosen = (
            joined(
                "and",
                (
                    _equal(ir.Signal(TARGET), float(i)),
                    shortfall.of(target),
                    *[ir.Temporal("always", ir.Window(1, 1), held)] * (i in late),
                ),
                ir.Truth(True),
            )
            for i, target in enumerate(targets)
        )
        now = ir.Signal(ir.ELAPSED)
        times = _at_least(now, ir.Signal(FIRST)), _at_least(ir.Signal(LAST), now)
        reached = ir.BoolOp("and", (*times, joined("or", chosen, ir.Truth(False))))
        formula = simplify(ir.Until("until", ir.Window(0, steps), held, reached))
        try:
            library = load(emit(motion, [formula], "truncate"))
        except Untranslatable:
            return None
        if library is None:
            return None
        sizes = Sizes(len(motion.states), len(motion.controls), steps, 1)
        return cls(Kernel(library, sizes), system, steps, len(untils))

    def reach(self, state: Numbers, ask: Ask, random: Generator, effort: int = 1) -> Phase:
        """Search for a phase from `state`, (n,), and make it shorter if it is found.

        `effort` is a factor of the generations of local searches.
        """
        row = self._row(state, ask)
        plans = np.broadcast_to(self._middle, (1, *self._bank[0].shape))
        for _ in range(ROUNDS):
            plans, rho = self._improved(row, plans, random, effort)
            found = (
                max((self._phase(row, plan) for plan in plans), key=lambda phase: phase.margin)
                if rho.max() < 0
                else self._phase(row, plans[int(rho.argmax())])
            )
            if found.margin >= 0.0:
                break
            plans = plans[(-rho).argsort()[:KEPT]]
        shares = iter(SHORTER)
        share = next(shares)
        while found.margin >= 0.0 and found.sample > ask.first + 1:
            row = self._row(state, replace(ask, last=max(ask.first, int(share * found.sample))))
            plans, rho = self._improved(row, found.plan[None], random, effort)
            better = self._phase(row, plans[int(rho.argmax())])
            if better.margin >= 0.0:
                found = better
            elif (share := next(shares, 0.0)) == 0.0:
                break
        return found

    def _improved(
        self, row: Numbers, plans: Numbers, random: Generator, effort: int
    ) -> tuple[Numbers, Numbers]:
        """Improve plans, (k, L, m), and return those that result, with their robustness.

        First, all plans are judged that follow one of the given plans up to some step, and keep one level
        from there. If none reaches the target, the best for each level is improved by local search.
        """
        steps, levels = self.steps, len(self._bank)
        before = np.arange(steps) < np.arange(steps)[:, None]
        switched = np.where(before[None, None, :, :, None], plans[:, None, None], self._bank[:, None])
        whole = switched.swapaxes(0, 1).reshape(levels, -1, *plans.shape[1:])
        rows, own = np.repeat(row, levels, 0), row.shape[1] - self._untils - WEIGHTS
        rows[1:, own : own + WEIGHTS] = np.exp(SPREAD * random.standard_normal((levels - 1, WEIGHTS)))
        rho, _ = self._kernel.judge(np.repeat(rows, whole.shape[1], 0), whole.reshape(-1, *plans.shape[1:]))
        rho = np.nan_to_num(rho[:, 0], nan=-np.inf).reshape(levels, -1)
        best = whole[np.arange(levels), rho.argmax(1)]
        self.tried += rho.size
        if rho.max() >= 0.0:
            return best, rho.max(1)
        kept = (-rho.max(1)).argsort()[:CLIMBED]
        best, rows = best[kept], rows[kept]
        options = SearchOptions(
            self._bounds, np.ones(1), self._bank, effort * GENERATIONS, 0.0, int(random.integers(2**62))
        )
        self.tried += len(best) * effort * GENERATIONS * LANES
        best, rho = self._kernel.climb(rows, best, options)
        return best, np.nan_to_num(rho, nan=-np.inf)

    def margin(self, state: Numbers, ask: Ask) -> float:
        """Robustness of the target of a request in `state`, (n,), itself."""
        middle = np.broadcast_to(self._middle, (1, self.steps, len(self._middle)))
        rho, _ = self._kernel.judge(self._row(state, replace(ask, first=0, last=0)), middle)
        return float(rho[0, 0])

    def _row(self, state: Numbers, ask: Ask) -> Numbers:
        opened = [float(i in ask.open) for i in range(self._untils)]
        return np.array([[*state, ask.target, ask.first, ask.last, *[1.0] * WEIGHTS, *opened]])

    def _phase(self, row: Numbers, plan: Numbers) -> Phase:
        """Return the phase of a plan, up to the first sample at which it reaches the target."""
        ends, own = np.repeat(row, self.steps + 1, 0), row.shape[1] - self._untils - 3 - WEIGHTS
        ends[:, own + 2] = np.minimum(np.arange(self.steps + 1), row[0, own + 2])
        rho, columns = self._kernel.judge(ends, np.repeat(plan[None], self.steps + 1, 0), columns=True)
        assert columns is not None
        margins = rho[:, 0]
        good = np.flatnonzero(margins >= 0.0)
        sample = int(good[0]) if len(good) else int(np.nan_to_num(margins, nan=-np.inf).argmax())
        margin = 0.0 if len(good) else float(margins[sample])
        return Phase(plan, columns[:own, :, 0].T, sample, margin)


def levels(*ends: Numbers, most: int) -> Numbers:
    """Return combinations of levels of the controls, (k, m), the nearest to the middle of the range first.

    If there are more than `most` combinations, some of them are drawn at random.

    Args:
        ends: levels that each control may have, (m,) each.
        most: largest number of combinations.
    """
    table = np.stack(ends)
    count, controls = table.shape
    if count**controls <= most:
        pick = np.array(list(product(range(count), repeat=controls))).reshape(-1, controls)
    else:
        pick = np.random.default_rng(0).integers(count, size=(most, controls))
    found: Numbers = table[pick, np.arange(controls)]
    order = np.abs(found - table.mean(0)).sum(1).argsort(kind="stable")
    return np.ascontiguousarray(found[order])


class _Shortfall:
    """Lack of a state for a formula, as a formula whose robustness is 0 where nothing is missing.

    What a conjunction lacks is the sum over its items, each in units of its typical size: unlike a minimum,
    it becomes less with every item that comes nearer. Predicates that read the same states form a group;
    each group has a weight, which is a state of the kernel.

    Args:
        scale: function that returns the typical size of the margin of a predicate.
    """

    def __init__(self, scale: Callable[[ir.Formula], float]) -> None:
        self._scale = scale
        self._groups: dict[frozenset[str], int] = {}

    def of(self, formula: ir.Formula) -> ir.Formula:
        """Return a formula whose robustness is the negative of what `formula` lacks."""
        if isinstance(formula, ir.Truth):
            return formula
        if not all(isinstance(node, (ir.Truth, ir.Predicate, ir.BoolOp)) for node in nodes(formula)):
            return map_children(formula, formulas=self.of)
        return ir.Predicate(ir.Op("neg", (self._lack(formula),)))

    def _lack(self, formula: ir.Formula) -> ir.Num:
        match formula:
            case ir.Predicate(num, sign, strict):
                margin = num if sign > 0 else ir.Op("neg", (num,))
                spare = ir.Op("sub", (margin, ir.Const(SPARE))) if strict else margin
                share = ir.Const(1.0 / self._scale(formula))
                group = self._groups.setdefault(columns(formula), len(self._groups)) % WEIGHTS
                weight = ir.Op("mul", (ir.Signal(WEIGHT.format(group)), share))
                return ir.Op("mul", (ir.Op("relu", (ir.Op("neg", (spare,)),)), weight))
            case ir.BoolOp(op, items):
                name = "add" if op == "and" else "min"
                return reduce(lambda a, b: ir.Op(name, (a, b)), map(self._lack, items))
            case ir.Truth(value):
                return ir.Const(0.0 if value else 1.0)
            case _:
                raise TypeError(f"not a state formula: {formula!r}")


def _decisive(formula: ir.Formula) -> ir.Formula:
    """Return a formula whose robustness is +inf or -inf: whether it holds counts, not by how much."""
    if isinstance(formula, ir.Predicate):
        return replace(formula, guard=True)
    return map_children(formula, formulas=_decisive)


def _at_least(left: ir.Num, right: ir.Num) -> ir.Predicate:
    return ir.Predicate(ir.Op("sub", (left, right)), guard=True)


def _equal(left: ir.Num, value: float) -> ir.Predicate:
    apart = ir.Op("abs", (ir.Op("sub", (left, ir.Const(value))),))
    return ir.Predicate(ir.Op("sub", (ir.Const(0.5), apart)), guard=True)
