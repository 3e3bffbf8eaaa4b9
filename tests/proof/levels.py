"""Robustness by level sets: a second evaluator, with nothing in common with `reference`.

Only truth is defined here. A formula at level r is the formula with every predicate asked for a margin of r,
those under a negation for a margin of r on the other side; its *level set* is the set of instants at which
that holds. Robustness at an instant is then the greatest level whose set contains it: min and max appear
nowhere. Boolean semantics are the same sets with predicates that are plainly true or false.

A set of instants is an integer, bit t for instant t. Beyond the last sample of a trace that may go on nothing
is known: pessimists (`lower`) take no predicate there for met nor for failed, optimists (`upper`) take it
for both. Windows to the end of a trace that is `growing` may end with any sample from its last one on:
pessimists let those that search end at once and those that guard never, optimists the other way round.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, reduce
from itertools import count
from typing import Literal, TypeAlias

from proof.language import (
    Atom,
    Choice,
    Constant,
    Edge,
    Formula,
    Frozen,
    Many,
    Meet,
    Not,
    Over,
    Pair,
    Row,
    Step,
    Use,
    Window,
    nodes,
    parts,
    windows,
)

Instants: TypeAlias = int
End: TypeAlias = Literal["truncate", "lower", "upper"]
Met: TypeAlias = Callable[[Atom, float], bool]
"""Truth of a predicate with this margin."""

FUTURE = ("always", "eventually", "until", "release", "unless")


@dataclass(frozen=True)
class Record:
    """A trace, and what is thought of the time after it: with `stop` it will have so many samples.

    `growing`: it may end with any sample from the last one on.
    """

    rows: Sequence[Row]
    end: End
    ahead: int = 0
    stop: int = 0
    growing: bool = False
    margins: dict[tuple[object, ...], float | None] = field(default_factory=dict)
    """Margins of predicates: (predicate, instant, frozen values) -> margin."""

    @property
    def samples(self) -> int:
        return len(self.rows)

    @property
    def size(self) -> int:
        """Instants that exist."""
        return self.samples if self.end == "truncate" else self.length + self.ahead

    @property
    def length(self) -> int:
        """End of windows that reach to the end of the trace."""
        return self.samples if self.end == "truncate" else max(self.samples, self.stop)

    @cached_property
    def everywhere(self) -> Instants:
        return (1 << self.size) - 1

    @cached_property
    def unknown(self) -> Instants:
        return self.everywhere & ~((1 << self.samples) - 1)

    @property
    def assume_missing_true(self) -> Instants:
        """Truth that an upper bound assumes where nothing is known."""
        return self.unknown if self.end == "upper" else 0


def inside(window: Window, k: int, *, outward: bool) -> bool:
    """True if a window reads the instant k steps away; `outward` adds neighbours of bounds off the grid."""
    low, high = window.lo, window.hi
    if outward and low.denominator != 1 and k == math.floor(low):
        return True
    if outward and high is not None and high.denominator != 1 and k == math.ceil(high):
        return True
    if k < low or (k == low and window.lo_open):
        return False
    return high is None or k < high or (k == high and not window.hi_open)


def ahead(formula: Formula) -> int:
    """At least as many steps as `formula` reads beyond its instant through bounded windows."""
    steps = sum(isinstance(node, Step) for node in nodes(formula))
    return steps + sum(math.ceil(w.hi if w.hi is not None else w.lo) + 1 for w in windows(formula))


class Sets:
    """Sets of instants at which a formula is met, or failed, for one way to ask of predicates."""

    def __init__(self, record: Record, met: Met, failed: Met, held: Row | None = None) -> None:
        self.record = record
        self.held = held or {}
        self._asks = {True: met, False: failed}
        self._known: dict[tuple[int, bool], Instants] = {}

    def of(self, formula: Formula, truth: bool = True) -> Instants:
        """Instants at which `formula` is met (`truth`), or its negation is."""
        key = (id(formula), truth)
        if key not in self._known:
            self._known[key] = self._of(formula, truth) & self.record.everywhere
        return self._known[key]

    def _of(self, formula: Formula, truth: bool) -> Instants:
        match formula:
            case Constant(value):
                return self.record.everywhere if value is truth else 0
            case Atom():
                return self._atom(formula, truth)
            case Frozen():
                return self._frozen(formula, truth)
            case Not(body):
                return self.of(body, not truth)
            case Many(op, items):
                return _joined([self.of(item, truth) for item in items], every=(op == "and") is truth)
            case Pair():
                return self._pair(formula, truth)
            case Choice(cond, yes, no):
                first = _joined([self.of(cond, truth), self.of(yes, truth)], every=truth)
                second = _joined([self.of(cond, not truth), self.of(no, truth)], every=truth)
                return _joined([first, second], every=not truth)
            case Over():
                return self._over(formula, truth)
            case Meet():
                return self._meet(formula, truth)
            case Step(steps, body):
                return self._step(steps, body, truth)
            case Edge(op, body):
                rising = op == "rise"
                now, before = self.of(body, rising is truth), self.of(body, rising is not truth) << 1
                return now & before & ~1 if truth else now | before | 1
            case Use():
                return self.of(formula.meaning, truth)
        raise TypeError(formula)

    def _atom(self, atom: Atom, truth: bool) -> Instants:
        """Truth of the unknown, where a sample or a frozen value that is read does not exist."""
        ask, found, end = self._asks[truth], self.record.assume_missing_true, self.record.end
        for t, row in enumerate(self.record.rows):
            key = (atom, t, *self.held.items())
            if key not in self.record.margins:
                self.record.margins[key] = margin_of(atom, row, self.held)
            margin = self.record.margins[key]
            lost = end == "upper" or (end == "truncate" and not truth)
            if lost if margin is None else ask(atom, margin):
                found |= 1 << t
        return found

    def _frozen(self, formula: Frozen, truth: bool) -> Instants:
        """Every instant has sets of its own, for the values that it keeps."""
        found = 0
        for t in range(self.record.size):
            held = kept(formula, self.record.rows[t] if t < self.record.samples else {}, self.held)
            own = Sets(self.record, self._asks[True], self._asks[False], held)
            found |= own.of(formula.body, truth) & 1 << t
        return found

    def _pair(self, formula: Pair, truth: bool) -> Instants:
        left = {value: self.of(formula.left, value) for value in (True, False)}
        right = {value: self.of(formula.right, value) for value in (True, False)}
        if formula.op == "->":
            return _joined([left[not truth], right[truth]], every=not truth)
        same = truth is (formula.op == "<->")
        if same:
            return (left[False] | right[True]) & (left[True] | right[False])
        return (left[True] & right[False]) | (left[False] & right[True])

    # ---------------------------------------------------------------- windows

    def _over(self, formula: Over, truth: bool) -> Instants:
        every = (formula.op in ("always", "historically")) is truth
        if formula.window.absolute:
            relative = Over(formula.op, replace(formula.window, absolute=False), formula.body)
            return self._from_start(self._over(relative, truth))
        look = _Look(self.record, formula.window, formula.op in FUTURE, every)
        body = self.of(formula.body, truth)
        met = [look.at(body, k) for k in look.distances]
        return look.settled(_joined(met, every=every, empty=self.record.everywhere))

    def _meet(self, formula: Meet, truth: bool) -> Instants:
        """Until and since: some instant of the window, and all from here to there; release turns it over."""
        window = formula.window
        if window.absolute:
            relative = Meet(formula.op, replace(window, absolute=False), formula.left, formula.right)
            return self._from_start(self._meet(relative, truth))
        if formula.op == "unless":
            held, met = unfolded(formula)
            return _joined([self._over(held, truth), self._meet(met, truth)], every=not truth)
        every = (formula.op == "release") is truth
        look = _Look(self.record, window, formula.op != "since", every)
        left, right = self.of(formula.left, truth), self.of(formula.right, truth)
        found = self.record.everywhere if every else 0
        on_the_way = 0 if every else self.record.everywhere
        for k in range(max(look.distances, default=-1) + 1):
            step = look.at(left, k)
            on_the_way = on_the_way | step if every else on_the_way & step
            if k in look.distances:
                here = look.at(right, k)
                found = found & (here | on_the_way) if every else found | (here & on_the_way)
        return look.settled(found)

    def _from_start(self, found: Instants) -> Instants:
        """The mission clock: what holds at the first sample holds whenever it is asked."""
        return self.record.everywhere if found & 1 else 0

    def _step(self, steps: int, body: Formula, truth: bool) -> Instants:
        """Outside of a trace that is cut nothing is true; of one that may go on nothing is known."""
        inner = self.of(body, truth)
        moved = inner >> 1 if steps > 0 else inner << 1
        lost = 1 << (self.record.size - 1) if steps > 0 else 1
        if self.record.end == "truncate":
            return moved | (0 if truth else lost)
        return moved & ~lost | (lost if self.record.end == "upper" else 0)


@dataclass(frozen=True)
class _Look:
    """View of the instants of a record through a window: all that they see (`every`), or some of it."""

    record: Record
    window: Window
    forward: bool
    every: bool

    @cached_property
    def distances(self) -> list[int]:
        return [k for k in range(self.record.size) if inside(self.window, k, outward=self.every)]

    @property
    def _to_the_end(self) -> bool:
        return self.forward and self.window.hi is None

    @property
    def _endless(self) -> bool:
        """True if the window may take samples for ever."""
        return self._to_the_end and self.record.growing and self.every is (self.record.end == "lower")

    def _steady(self, instants: Instants) -> Instants:
        """Last instant that differs: later ones, whose windows reach no sample, are alike.

        The record is finite and has to be cut somewhere; what looks beyond the cut must not decide.
        """
        far = self.record.length + self.record.ahead // 2
        rest = self.record.everywhere >> far << far
        return instants | rest if instants >> far & 1 else instants & ~rest

    @cached_property
    def _visible(self) -> Instants:
        """A window to the end takes the samples there are; while a trace grows it may take more."""
        if self._endless:
            return self.record.everywhere
        return (1 << self.record.length) - 1 if self._to_the_end else self.record.everywhere

    def at(self, instants: Instants, k: int) -> Instants:
        """Instants that are in the set k steps away; where there is nothing to see, `every` is content."""
        if self._endless:
            instants = self._steady(instants)
        if self.forward:
            seen, seeing = (instants & self._visible) >> k, self._visible >> k
        else:
            seen, seeing = instants << k, self.record.everywhere >> k << k
        return seen | (self.record.everywhere & ~seeing) if self.every else seen & seeing

    def settled(self, found: Instants) -> Instants:
        """Nobody knows what a window to the end holds that starts after the last sample."""
        if not self._to_the_end or self.record.end == "truncate":
            return found
        first = next(k for k in count() if inside(self.window, k, outward=self.every))
        none = self.record.everywhere & ~((1 << self.record.length) - 1 >> first)
        return found & ~none | (none if self.record.end == "upper" else 0)


def unfolded(formula: Meet) -> tuple[Over, Meet]:
    """`p unless[a, b] q` is `always[0, b] p` or `p until[a, b] q`."""
    whole = replace(formula.window, lo=Fraction(0), lo_open=False)
    held = Over("always", whole, formula.left)
    return held, Meet("until", formula.window, formula.left, formula.right)


def _joined(sets: Sequence[Instants], *, every: bool, empty: Instants = 0) -> Instants:
    if not sets:
        return empty if every else 0
    return reduce(int.__and__ if every else int.__or__, sets)


# ------------------------------------------------------------------ what is asked


def robustness(formula: Formula, record: Record) -> list[float]:
    """At every sample: the greatest level whose set has it."""
    margins = set(margins_of(formula, record, {}))
    levels = sorted({*margins, *(-m for m in margins), math.inf}, reverse=True)
    found = [-math.inf] * record.samples
    missing = (1 << record.samples) - 1
    for level in levels:
        sets = Sets(record, lambda _, m, r=level: m >= r, lambda _, m, r=level: -m >= r)
        fresh = sets.of(formula) & missing
        for t in range(record.samples):
            if fresh >> t & 1:
                found[t] = level
        missing &= ~fresh
        if not missing:
            break
    return found


def margins_of(formula: Formula, record: Record, held: Row) -> Iterator[float]:
    """The margins of all predicates at all samples, whatever is frozen."""
    match formula:
        case Atom():
            found = (margin_of(formula, row, held) for row in record.rows)
            yield from (margin for margin in found if margin is not None)
        case Frozen(_, body):
            for row in [*record.rows, {}]:
                yield from margins_of(body, record, kept(formula, row, held))
        case _:
            for part in parts(formula):
                yield from margins_of(part, record, held)


def margin_of(atom: Atom, row: Row, held: Row) -> float | None:
    """None where it reads what does not exist."""
    try:
        return atom.margin({**row, **held})
    except KeyError:
        return None


def kept(formula: Frozen, row: Row, held: Row) -> Row:
    """Values frozen inside of the formula at an instant; names without a value are left out."""
    found = {name: value for name, value in held.items() if name not in {n for n, _, _ in formula.bindings}}
    for name, _, value in formula.bindings:
        try:
            found[name] = value({**row, **held})
        except KeyError:
            continue
    return found


def truth(formula: Formula, record: Record) -> list[bool]:
    """Boolean semantics at every sample: `>` is strict, `>=` is not, and there is no tolerance."""

    def true(atom: Atom, margin: float) -> bool:
        return margin > 0 if atom.strict else margin >= 0

    held = Sets(record, true, lambda atom, margin: not true(atom, margin)).of(formula)
    return [bool(held >> t & 1) for t in range(record.samples)]
