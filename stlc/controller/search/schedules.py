"""Schedules: random choices of the samples at which the parts of a formula must hold.

A schedule selects one sample for every `eventually` and `until` of a specification, and one operand of every
`or` of temporal formulas. After these choices, only conditions on the states at known samples are left. A
trajectory that meets these conditions satisfies the specification.

Example: for `eventually@[0 s, 9 s] x > 1`, one schedule is "x > 1 at 4 s".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir

Instants = NDArray[np.int64]
Flags = NDArray[np.bool_]

MOST_INSTANTS = 16
"""Longest window of an `always` whose operand has choices of its own; of longer ones, the first sample."""
MOST_ALTERNATIVES = 8
"""Largest number of alternatives in conditions among which a schedule chooses."""


class GoalScheduler:
    """Generator of random schedules for given formulas.

    A formula that only compares the states of one sample is called a condition. Schedules leave out some
    parts of the formulas: past operators; `freeze`; all samples but the first of an `always` over a long
    window that contains other temporal operators; and comparisons that read signals other than states.
    Therefore a trajectory may meet a schedule and still violate the formulas.

    Attributes:
        conditions: the conditions in the formulas. A conjunction is split into its parts.
        choices: the conditions that are an `or` of which a schedule may choose one operand, which is a
            condition, too; none if there are many.
    """

    def __init__(self, formulas: Sequence[ir.Formula], states: Sequence[str], steps: int) -> None:
        self._formulas, self._states, self._steps = tuple(formulas), frozenset(states), steps
        self._numbers: dict[ir.Formula, int] = {}
        self._depths: dict[int, int] = {}
        self._decidable: dict[int, bool] = {}
        for formula in formulas:
            self._collect(formula)
        choices = [each for each in self._numbers if isinstance(each, ir.BoolOp)]
        few = sum(len(each.items) for each in choices) <= MOST_ALTERNATIVES
        self.choices = frozenset(choices if few else ())
        for item in (item for choice in choices if few for item in choice.items):
            self._collect(item)
        self.conditions = tuple(self._numbers)
        self._opposed = {
            i: self._numbers[_opposite(condition)]
            for condition, i in self._numbers.items()
            if isinstance(condition, ir.Predicate) and _opposite(condition) in self._numbers
        }

    def draw(self, count: int, random: Generator, holds: Flags | None = None) -> Flags:
        """Draw `count` schedules, and drop those that contradict themselves.

        Args:
            count: number of schedules.
            random: source of the random choices.
            holds: True for the conditions that hold at the first sample, (conditions,); None if unknown.

        Returns:
            True where a schedule needs a condition at a sample, (schedules, conditions, T + 1).
        """
        drawing = _Drawing(self, count, random, holds)
        for i in random.permutation(len(self._formulas)):
            formula = self._formulas[i]
            drawing.need(formula, np.zeros(count, np.int64), np.ones(count, np.bool_))
        possible = drawing.possible
        for i, j in self._opposed.items():
            possible &= ~(drawing.needed[:, i] & drawing.needed[:, j]).any(1)
        return drawing.needed[possible]

    def nearest(self, distance: NDArray[np.float64]) -> Flags:
        """Select for each trajectory the schedule that it meets, or is nearest to.

        Args:
            distance: distance of each sample from the boundary of each condition, negative where the
                condition is violated, (trajectories, conditions, T + 1).

        Returns:
            True where a schedule needs a condition at a sample, (trajectories, conditions, T + 1).
        """
        choice = _Nearest(self, distance)
        for formula in self._formulas:
            choice.need(formula, np.zeros(len(distance), np.int64), np.ones(len(distance), np.bool_))
        return choice.needed

    @property
    def steps(self) -> int:
        """Number of steps of a plan."""
        return self._steps

    def number(self, condition: ir.Formula) -> int:
        """Index of `condition` in `conditions`."""
        return self._numbers[condition]

    def opposite(self, condition: ir.Formula) -> int | None:
        """Index of the negation of `condition` in `conditions`; None if the negation is not there."""
        return self._opposed.get(self._numbers.get(condition, -1))

    def depth(self, formula: ir.Formula) -> int:
        """Greatest nesting depth of the operators in `formula` for which a schedule chooses a sample.

        Example: 2 for `eventually (p and eventually q)`.
        """
        found = self._depths.get(id(formula))
        if found is None:
            own = isinstance(formula, ir.Windowed) and formula.op in ("eventually", "until", "release")
            found = self._depths[id(formula)] = own + max(map(self.depth, formula.operands), default=0)
        return found

    def decidable(self, formula: ir.Formula) -> bool:
        """True if a formula only compares the states of one sample, that is, if it is a condition."""
        known = self._decidable.get(id(formula))
        if known is None:
            read = (
                leaf for num in formula.numbers() for leaf in num.leaves() if not isinstance(leaf, ir.Const)
            )
            known = self._decidable[id(formula)] = all(
                isinstance(node, (ir.Truth, ir.Predicate, ir.BoolOp)) for node in formula.walk()
            ) and all(isinstance(leaf, ir.Signal) and leaf.name in self._states for leaf in read)
        return known

    @cached_property
    def forms(self) -> tuple[list[ir.Formula], list[ir.Formula]]:
        """The operands of choices; and each with signals `0`, `1`, … in place of the conditions.

        What a schedule leaves out is true there.
        """
        left, asked = list(self._formulas), list[ir.Formula]()
        for formula in left:
            if not self.decidable(formula):
                left.extend(formula.operands)
                if isinstance(formula, ir.Until) or getattr(formula, "op", "") in ("or", "eventually"):
                    asked.extend(formula.operands)
        return asked, [self._named(formula) for formula in asked]

    def _named(self, formula: ir.Formula) -> ir.Formula:
        if (number := self._numbers.get(formula)) is not None:
            return ir.Predicate(ir.Signal(str(number)))
        if isinstance(formula, (ir.Truth, ir.BoolOp, ir.AtStart, ir.Temporal, ir.Until)):
            return formula.map_children(formulas=self._named)
        return ir.Truth(True)

    def present(self, formula: ir.Formula) -> Iterator[ir.Formula]:
        """Yield the conditions that must hold at a sample if `formula` is to hold at this sample.

        Conditions at other samples, such as those inside `eventually`, are not included.
        """
        match formula:
            case ir.BoolOp("and", items):
                for item in items:
                    yield from self.present(item)
            case ir.Temporal("always", ir.Window(0), body):
                yield from self.present(body)
            case _ if self.decidable(formula):
                yield formula

    def _collect(self, formula: ir.Formula) -> None:
        if self.decidable(formula):
            for part in formula.terms("and"):
                if not isinstance(part, ir.Truth):
                    self._numbers.setdefault(part, len(self._numbers))
            return
        for part in formula.operands:
            self._collect(part)


def _opposite(condition: ir.Predicate) -> ir.Predicate:
    return replace(condition, sign=-condition.sign, strict=not condition.strict)


class _Drawing:
    """Many schedules that are drawn at the same time.

    Attributes:
        needed: True where a schedule needs a condition at a sample, (schedules, conditions, T + 1).
        possible: False for a schedule in which no sample was left for some formula, (schedules,).
    """

    def __init__(self, scheduler: GoalScheduler, count: int, random: Generator, holds: Flags | None) -> None:
        self._scheduler, self._random, self._holds = scheduler, random, holds
        self._last = scheduler.steps
        self._samples = np.arange(scheduler.steps + 1)
        self.needed = np.zeros((count, len(scheduler.conditions), scheduler.steps + 1), np.bool_)
        self.possible = np.ones(count, np.bool_)

    def need(self, formula: ir.Formula, now: Instants, on: Flags) -> None:
        """Make every schedule selected by `on` demand that `formula` holds at a given sample.

        The demand is broken down into conditions on states, which are added to `needed`. Samples in windows
        and operands of an `or` are chosen at random.

        Args:
            formula: the formula.
            now: for each schedule, the index of the sample at which the formula must hold, (schedules,).
            on: True for the schedules that get the demand, (schedules,); the others stay unchanged.
        """
        if not on.any():
            return
        if self._scheduler.decidable(formula):
            self._hold(formula, now, now, on)
            return
        match formula:
            case ir.BoolOp("and", items):
                for i in self._random.permutation(len(items)):
                    self.need(items[i], now, on)
            case ir.BoolOp("or", items):
                chosen = self._alternative(items, now)
                for i, item in enumerate(items):
                    self.need(item, now, on & (chosen == i))
            case ir.AtStart(body):
                self.need(body, np.zeros_like(now), on)
            case ir.Shift(steps, body):
                there = now + steps
                inside = (there >= 0) & (there <= self._last)
                self.possible &= inside | ~on | (formula.outside is True)
                self.need(body, there, on & inside)
            case ir.Temporal() | ir.Until():
                self._window(formula, now, on)

    def _alternative(self, items: Sequence[ir.Formula], now: Instants) -> Instants:
        """Choose at random, in each schedule, the operand of an `or` that shall hold at the sample `now`."""
        each = np.arange(len(now))
        free = np.stack([self._free(item)[each, now] for item in items])
        known = np.stack([(now == 0) & self._known(item) for item in items])
        chosen: Instants = (self._random.random(free.shape) + free + known).argmax(0)
        return chosen

    def _released(self, formula: ir.Until, now: Instants, within: Flags) -> Flags:  # noqa: ARG002
        """Choose at random the schedules in which `left` releases `right` at a sample of the window."""
        return within.any(1) & (self._random.random(len(within)) < 0.5)

    def _window(self, formula: ir.Temporal | ir.Until, now: Instants, on: Flags) -> None:
        window = formula.window
        first = now + window.lo
        last = np.full_like(now, self._last) if window.hi is None else np.minimum(now + window.hi, self._last)
        within = (self._samples >= first[:, None]) & (self._samples <= last[:, None])
        match formula:
            case ir.Temporal("always", _, body):
                self._always(body, first, last, on)
            case ir.Temporal("eventually", _, body):
                chosen, on = self._chosen(formula, now, within & self._free(body), on)
                self.need(body, chosen, on)
            case ir.Until("until", _, left, right):
                before = np.where(self._samples < now[:, None], True, self._free(left))
                within &= np.logical_and.accumulate(before, axis=1)
                chosen, on = self._chosen(formula, now, within & self._free(right), on)
                self._always(left, now, chosen, on)
                self.need(right, chosen, on)
            case ir.Until("release", _, left, right):  # released by `left`, or `right` over the whole window
                released = on & self._released(formula, now, within)
                chosen, released = self._chosen(formula, now, within, released)
                self.need(left, chosen, released)
                self._always(right, first, np.where(released, chosen, last), on)

    def _chosen(
        self,
        formula: ir.Temporal | ir.Until,
        now: Instants,  # noqa: ARG002
        allowed: Flags,
        on: Flags,
    ) -> tuple[Instants, Flags]:
        """Choose at random, in each schedule selected by `on`, one of the allowed samples.

        If further choices are nested in the formula, early samples are more likely, so that time is left for
        these choices: with n choices in total, including this one, the earliest of n random samples is taken.

        Args:
            formula: formula for which the sample is chosen.
            now: sample at which the formula shall hold, (schedules,).
            allowed: True at the allowed samples, (schedules, T + 1).
            on: True for the schedules in which a sample is to be chosen, (schedules,).

        Returns:
            The chosen samples, (schedules,); and a mask of the schedules in `on` that had an allowed sample,
            (schedules,).
        """
        count = allowed.sum(1)
        share = 1.0 - self._random.random(len(on)) ** (1.0 / self._scheduler.depth(formula))
        rank = (share * count).astype(np.int64)
        chosen: Instants = (allowed.cumsum(1, dtype=np.int32) > rank[:, None]).argmax(1)
        self.possible &= (count > 0) | ~on
        return chosen, on & (count > 0)

    def _free(self, formula: ir.Formula) -> Flags:
        """Mask of the samples at which `formula` can hold in each schedule, (schedules, T + 1).

        A sample is excluded if it would lead to a contradiction: the schedule already demands, at this
        sample, the negation of a condition that `formula` needs; or the first sample violates the condition.
        """
        free = np.ones((len(self.needed), self._last + 1), np.bool_)
        for part in self._scheduler.present(formula):
            free[:, 0] &= self._holds is None or self._known(part)
            other = self._scheduler.opposite(part)
            if other is not None:
                free &= ~self.needed[:, other]
        return free

    def _known(self, formula: ir.Formula) -> bool:
        """True if `formula` is a condition that is known to hold at the first sample."""
        if self._holds is None or not self._scheduler.decidable(formula):
            return False
        match formula:
            case ir.Truth(value):
                return value
            case ir.BoolOp("and", items):
                return all(map(self._known, items))
            case _:
                return bool(self._holds[self._scheduler.number(formula)])

    def _always(self, formula: ir.Formula, first: Instants, last: Instants, on: Flags) -> None:
        if self._scheduler.decidable(formula):
            self._hold(formula, first, last, on)
            return
        length = int((last - first)[on].max(initial=-1)) + 1
        for k in range(length if length <= MOST_INSTANTS else 1):
            self.need(formula, first + k, on & (first + k <= last))

    def _hold(self, formula: ir.Formula, first: Instants, last: Instants, on: Flags) -> None:
        """Make the schedules selected by `on` demand that `formula` holds from `first` to `last`.

        `formula`: a condition. `first`, `last`: indices of samples, one per schedule, (schedules,).
        """
        within = (self._samples >= first[:, None]) & (self._samples <= last[:, None])
        self._demand(formula, within & on[:, None])

    def _demand(self, formula: ir.Formula, within: Flags) -> None:
        """Demand that a condition holds at samples, (schedules, T + 1)."""
        for part in formula.terms("and"):
            if isinstance(part, ir.Truth):
                self.possible &= part.value | ~within.any(1)
            else:
                self.needed[:, self._scheduler.number(part)] |= within
                if part in self._scheduler.choices:
                    self._prefer(part, within)

    def _prefer(self, condition: ir.BoolOp, within: Flags) -> None:
        """Demand, in some schedules, one alternative of an `or` of comparisons in a part of the samples.

        On average, one such `or` is chosen for each schedule.
        """
        count, random = len(within), self._random
        begin, end = np.sort(random.integers(self._last + 1, size=(2, count)), axis=0)
        end[random.random(count) < 0.5] = self._last
        piece = within & (self._samples >= begin[:, None]) & (self._samples <= end[:, None])
        chosen = random.integers(len(self._scheduler.choices) * len(condition.items), size=count)
        for i, item in enumerate(condition.items):
            self._demand(item, piece & (chosen == i)[:, None])


class _Nearest(_Drawing):
    """The schedule that each of several trajectories meets, or is nearest to."""

    def __init__(self, scheduler: GoalScheduler, distance: NDArray[np.float64]) -> None:
        super().__init__(scheduler, len(distance), np.random.default_rng(0), None)
        env = {str(i): column.T for i, column in enumerate(distance.swapaxes(0, 1))}
        asked, forms = scheduler.forms
        worths = evaluate(forms, env, count=self._last + 1, end="truncate") if env else []
        shape = self._last + 1, len(distance)
        self._worths = {
            id(one): np.broadcast_to(worth, shape).T for one, worth in zip(asked, worths, strict=True)
        }

    def _alternative(self, items: Sequence[ir.Formula], now: Instants) -> Instants:
        there = np.arange(len(now)), now.clip(0, self._last)
        best: Instants = np.stack([self._worth(item)[there] for item in items]).argmax(0)
        return best

    def _prefer(self, condition: ir.BoolOp, within: Flags) -> None:
        pass

    def _released(self, formula: ir.Until, now: Instants, within: Flags) -> Flags:
        left, right = self._worth(formula.left), self._worth(formula.right)
        both = np.minimum(left, self._since(right, now + formula.window.lo))
        released: Flags = np.where(within, both, -np.inf).max(1) > np.where(within, right, np.inf).min(1)
        return released

    def _chosen(
        self, formula: ir.Temporal | ir.Until, now: Instants, allowed: Flags, on: Flags
    ) -> tuple[Instants, Flags]:
        match formula:
            case ir.Until("until", _, left, right):
                worth = np.minimum(self._worth(right), self._since(self._worth(left), now))
            case ir.Until(_, window, left, right):
                worth = np.minimum(self._worth(left), self._since(self._worth(right), now + window.lo))
            case _:
                worth = self._worth(formula.body)
        chosen: Instants = np.where(allowed, worth, -np.inf).argmax(1)
        return chosen, on & allowed.any(1)

    def _since(self, worth: NDArray[np.float64], first: Instants) -> NDArray[np.float64]:
        """Least worth from the sample `first` to each sample, (trajectories, T + 1)."""
        after = np.where(self._samples >= first[:, None], worth, np.inf)
        least: NDArray[np.float64] = np.minimum.accumulate(after, axis=1)
        return least

    def _worth(self, formula: ir.Formula) -> NDArray[np.float64]:
        """Least distance that decides a formula at each sample, (trajectories, T + 1); inf where unknown."""
        return self._worths[id(formula)]


def tempo(needed: Flags, apart: NDArray[np.float64]) -> NDArray[np.float64]:
    """Greatest speed that each schedule demands on the way from one goal to the next.

    A speed is a distance divided by the number of samples in which it must be covered.

    Args:
        needed: True where a schedule needs a goal at a sample, (schedules, goals, T + 1).
        apart: distances between places, (1 + goals, 1 + goals). Place 0 is the initial state; the others are
            the goals.

    Returns:
        Speeds, (schedules,); 0 for a schedule without goals.
    """
    count, goals, samples = needed.shape
    visited = np.logical_or.reduce(needed, axis=2)
    first = np.where(visited, needed.argmax(2), samples)
    last = samples - 1 - needed[:, :, ::-1].argmax(2)
    order = first.argsort(1, kind="stable")
    each = np.arange(count)
    place, left = np.zeros(count, np.int64), np.zeros(count, np.int64)
    greatest = np.zeros(count)
    for rank in range(goals):
        goal = order[:, rank]
        on = visited[each, goal]
        speed = apart[place, goal + 1] / np.maximum(first[each, goal] - left, 0.5)
        greatest = np.where(on, np.maximum(greatest, speed), greatest)
        place, left = np.where(on, goal + 1, place), np.where(on, last[each, goal], left)
    return greatest
