"""Obligations of a plan: the requirements as seen from a given state of the mission.

For plans, the compiler rewrites an absolute formula such as `p until@[0 s, 25 s] q` with states that it
adds: a mission clock, a status, and timers for the formulas within. That form is exact from every state, but
it hides the times at which the parts must hold. An obligation is the formula as it was written, with windows
that count from the state at hand: 5 s into the mission, `p until[0 s, 20 s] q`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, TypeGuard

import numpy as np

from stlc.compile.augment.lift import hoist_absolute
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import normal
from stlc.compile.ir.simplify import simplify
from stlc.compile.semantics.tolerance import TOLERANCE

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from stlc.controller.problem.task import Task


class Obligations:
    """The obligations of plans of one task.

    Answers that are due for what happened before the state at hand are obligations of their own. Anything
    else that began before is left out: of `eventually@[0 s, 9 s] always[0 s, 3 s] p`, the first second of p
    that has passed already. So a plan may miss an obligation and satisfy the requirement.
    """

    def __init__(self, task: Task) -> None:
        self._names, self._horizon = task.system.names, task.horizon
        self._clock = next((timer.name for timer in task.compiled.timers if timer.kind == "clock"), None)
        self._relative = tuple(rule.formula for rule in task.rules if not rule.absolute)
        absolute = [rule for rule in task.rules if rule.absolute]
        grid = task.compiled.grid
        self._written = [grid.lower(hoist_absolute(normal(rule.typed.formula), []), []) for rule in absolute]
        parts = [
            part
            for written, rule in zip(self._written, absolute, strict=True)
            for part in _parts(written, rule.lowered)
        ]
        self._progressed = [progressed for _, progressed in parts]
        self._known = lru_cache(maxsize=64)(self._formulas)
        own = frozenset(self._names) - {timer.name for timer in task.compiled.timers}
        self._responses = [each for part in parts for each in _responses(*part, own)]

    @property
    def first(self) -> tuple[ir.Formula, ...]:
        """The obligations at the start of a mission."""
        return self._known(0, (False,) * len(self._progressed))

    def at(self, state: Tensor) -> tuple[ir.Formula, ...]:
        """Return the obligations of plans from `state`, (n,), without those that every plan meets."""
        clock = 0 if self._clock is None else round(float(state[self._names.index(self._clock)]))
        if not clock:
            return self.first
        env = {name: np.array([[float(value)]]) for name, value in zip(self._names, state, strict=True)}
        bounds = evaluate(self._progressed, env, end="lower", stop=self._horizon + 1)
        met = tuple(bool(TOLERANCE.satisfied(np.broadcast_to(bound[0], 1))[0]) for bound in bounds)
        pending = (self._pending(response, env, clock) for response in self._responses)
        return (*self._known(clock, met), *(each for each in pending if each is not None))

    def _pending(
        self, response: _Response, env: Mapping[str, NDArray[np.float64]], clock: int
    ) -> ir.Formula | None:
        """Return the answer that is due for what happened up to the state `env`; None if there is none.

        To find the latest sample for it, the requirement is judged on plans without further triggers that
        answer at one sample after another, or never.
        """
        samples = np.arange(self._horizon + 1.0)[:, None]

        def good(answers: NDArray[np.float64]) -> NDArray[np.bool_]:
            shape = len(samples), len(answers)
            whole = {name: np.broadcast_to(value, shape) for name, value in env.items()}
            if self._clock is not None:
                whole[self._clock] = np.broadcast_to(clock + samples, shape)
            for name, part in response.parts.items():
                now = evaluate([ir.Predicate(part.num)], env)[0]
                later = np.where(samples < answers, -part.value, part.value) if part.answers else part.value
                whole[name] = np.where(samples == 0.0, now, later)
            judged = evaluate([response.form], whole, end="truncate")[0]
            return np.broadcast_to(TOLERANCE.satisfied(judged[0]), len(answers)).astype(np.bool_)

        if good(np.array([np.inf]))[0]:
            return None
        last = good(np.arange(1.0, response.latest + 1.0)).nonzero()[0]
        if not len(last) or last[-1] + 1 == response.latest:  # triggered at this sample
            return None
        return ir.Temporal("eventually", ir.Window(0, int(last[-1]) + 1), response.answer)

    def within(self, formula: ir.Formula) -> ir.Formula:
        """Return a state formula without alternatives that hold at no sample of the mission.

        Such an alternative is a condition on the mission clock, as in `clock > 216 or p`.
        """
        if not isinstance(formula, ir.BoolOp) or formula.op != "or":
            return formula
        time = np.arange(self._horizon + 1.0)[:, None]
        env = {name: time if name == self._clock else np.full_like(time, np.nan) for name in self._names}
        kept = [
            item
            for item in formula.items
            if item.columns != {self._clock} or bool((evaluate([item], env, count=len(time))[0] >= 0.0).any())
        ]
        return ir.BoolOp.joined("or", kept)

    def _formulas(self, clock: int, met: tuple[bool, ...]) -> tuple[ir.Formula, ...]:
        """Return the obligations at step `clock`; `met`: the parts of `_progressed` that every plan meets."""
        done = iter(met)
        shifted = (simplify(self._from(written, clock, done)) for written in self._written)
        return (*self._relative, *(each for each in shifted if each != ir.Truth(True)))

    def _from(self, written: ir.Formula, clock: int, done: Iterator[bool]) -> ir.Formula:
        """Return a requirement as it is at step `clock`, its windows counting from there.

        `done`: for each of its absolute formulas, in order, True if every plan meets it. A formula whose
        window is over counts as met, since no plan can change it. A goal that is due after the plan's end is
        left to later plans.
        """
        if _is_branch(written):
            return replace(written, items=tuple(self._from(item, clock, done) for item in written.items))
        formula, over = written.body if isinstance(written, ir.AtStart) else written, next(done)
        if not isinstance(formula, ir.Windowed):
            return ir.Truth(True) if over or clock else formula
        lo, hi = max(formula.window.lo - clock, 0), formula.window.hi
        last = None if hi is None else hi - clock
        if over or (last is not None and last < 0):
            return ir.Truth(True)
        if formula.op in ("eventually", "until") and (last is None or last > self._horizon):
            if isinstance(formula, ir.Until):
                return ir.Temporal("always", ir.Window(0, None), formula.left)
            return ir.Truth(True)
        return formula.with_window(lo, last)


@dataclass(frozen=True, slots=True)
class _Part:
    """A number of a requirement that a signal replaces.

    Attributes:
        num: the number.
        value: value of the signal with which the predicate on the number holds.
        answers: whether the predicate is a part of the answer.
    """

    num: ir.Num
    value: float
    answers: bool


@dataclass(frozen=True, slots=True)
class _Response:
    """A requirement such as `always@[a, b] (p -> eventually[c, d] q)`.

    Attributes:
        answer: the formula that becomes due, q.
        latest: number of samples after which it is due, d.
        form: the requirement on plans, with a signal for the number in each predicate.
        parts: the numbers, by the names of these signals.
    """

    answer: ir.Formula
    latest: int
    form: ir.Formula
    parts: Mapping[str, _Part]


def _responses(written: ir.Formula, form: ir.Formula, own: frozenset[str]) -> Iterator[_Response]:
    """Yield the responses that an absolute formula requires; `form`: its form for plans."""
    formula = written.body if isinstance(written, ir.AtStart) else written
    if not (isinstance(formula, ir.Temporal) and formula.op == "always"):
        return
    asked = [node for node in formula.walk() if isinstance(node, ir.Predicate) and node.columns & own]
    names = {node.num: f"#{i}" for i, node in enumerate(asked)}

    def named(node: ir.Formula) -> ir.Formula:
        if isinstance(node, ir.Predicate) and node.num in names:
            return replace(node, num=ir.Signal(names[node.num]))
        return node.map_children(formulas=named)

    for goal in formula.body.walk():
        if isinstance(goal, ir.Temporal) and goal.op == "eventually" and goal.window.hi:
            inside = {node.num for node in goal.body.walk() if isinstance(node, ir.Predicate)}
            order = sorted(asked, key=lambda node: node.num in inside)
            parts = {names[node.num]: _Part(node.num, float(node.sign), node.num in inside) for node in order}
            yield _Response(goal.body, goal.window.hi, named(form), parts)


def _parts(written: ir.Formula, progressed: ir.Formula) -> Iterator[tuple[ir.Formula, ir.Formula]]:
    """Yield the absolute formulas that a requirement joins by `and` and `or`, with their progressed forms."""
    if _is_branch(written) and isinstance(progressed, ir.BoolOp):
        for one, other in zip(written.items, progressed.items, strict=True):
            yield from _parts(one, other)
    else:
        yield written, progressed


def _is_branch(formula: ir.Formula) -> TypeGuard[ir.BoolOp]:
    """True for an `and` or `or` of formulas of which one looks ahead."""
    return isinstance(formula, ir.BoolOp) and any(
        isinstance(node, ir.AtStart) or (isinstance(node, ir.Windowed) and not node.back)
        for node in formula.walk()
    )
