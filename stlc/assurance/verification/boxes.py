"""Boxes of initial states: the random numbers behind a draw as coordinates from 0 to 1.

An initial state is a function of uniform random numbers. A mode fixes everything discrete: the situation, its
branches, and the outcomes of `bernoulli`, `choice` and `randint`. The probability of a mode times the volume
of a box is the probability of drawing a state in it, before the conditions of `where` reject some states.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from stlc.assurance.verification.forms import FORMS, Bools, Floats, Forms, spread
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.ir import nodes as ir
from stlc.compile.namespace import Array, Ops
from stlc.dynamics.declaration.init import InitDecl, Situation
from stlc.dynamics.declaration.motion import Assign

MOST_MODES = 1000
"""Most modes of a distribution."""


class Unsupported(Exception):  # noqa: N818 - becomes a diagnostic
    """Error: a distribution of initial states that has no boxes; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Box of coordinates of a mode.

    Attributes:
        centre: (coordinates,).
        half: half of its width in each coordinate, (coordinates,).
        refuted: whether a state in it is known to violate the specification.
        inside: whether all states in it are known to meet the conditions of `where`.
        hopeless: whether all choices violate the specification from all states that were sampled in it.
    """

    centre: Floats
    half: Floats
    refuted: bool = False
    inside: bool = True
    hopeless: bool = False

    @property
    def volume(self) -> float:
        """Share of the mode's probability, before `where`."""
        return float(np.prod(2.0 * self.half))

    def split(self, axis: int) -> tuple[Box, Box]:
        """Return the two halves along a coordinate."""
        half = self.half.copy()
        half[axis] *= 0.5
        step = np.zeros_like(half)
        step[axis] = half[axis]
        known = self.refuted, self.inside, self.hopeless
        return Box(self.centre - step, half, *known), Box(self.centre + step, half, *known)


def whole(mode: Mode) -> Box:
    """Box of all coordinates of a mode."""
    count = len(mode.coordinates)
    return Box(np.full(count, 0.5), np.full(count, 0.5), inside=mode.conditions is None)


def corners(boxes: Sequence[Box], names: Sequence[str]) -> dict[str, Forms]:
    """Coordinates over boxes: name -> form, of which coordinate i has symbol i."""
    table = {"": Forms.point(np.zeros(len(boxes)))}
    for i, name in enumerate(names):
        generators = np.zeros((i + 1, len(boxes)))
        generators[i] = [box.half[i] for box in boxes]
        table[name] = Forms(np.array([box.centre[i] for box in boxes]), generators, np.zeros(len(boxes)))
    return table


@dataclass(frozen=True, slots=True)
class Truths:
    """Truth of the conditions of `where` over boxes.

    Attributes:
        sure: whether they hold for all states of a box, (boxes,).
        possible: whether they may hold for some of them, (boxes,).
        effects: effect of each coordinate on the undecided conditions, (boxes, coordinates).
    """

    sure: Bools
    possible: Bools
    effects: Floats


class Conditions:
    """The conditions of `where`, over states and over boxes of states."""

    def __init__(self, conditions: Sequence[ir.Formula]) -> None:
        self._truth = ArrayProgram({str(i): each.indicator() for i, each in enumerate(conditions)})
        margins = (atom.num for each in conditions for atom in each.predicates())
        self._margins = ArrayProgram({str(i): num for i, num in enumerate(margins)})

    def holds(self, states: Mapping[str, Floats]) -> Bools:
        """True if states meet every condition: name -> (n,) to (n,)."""
        marks = [np.asarray(mark) > 0.5 for mark in self._truth(states).values()]
        found: Bools = np.logical_and.reduce(np.broadcast_arrays(*marks))
        return found

    def over(self, states: Mapping[str, Forms], coordinates: int) -> Truths:
        """Truth over boxes: name -> form."""
        marks = [mark.range for mark in self._truth(states, FORMS).values()]
        sure = np.logical_and.reduce(np.broadcast_arrays(*(mark.low > 0.5 for mark in marks)))
        possible = np.logical_and.reduce(np.broadcast_arrays(*(mark.high > 0.5 for mark in marks)))
        effects = np.full((coordinates, len(sure)), 1e-12)
        for margin in self._margins(states, FORMS).values():
            bound = margin.range
            crossing = ~((bound.low >= 0.0) | (bound.high <= 0.0))
            share = np.abs(margin.generators[:coordinates]) / np.maximum(margin.radius, 1e-300)
            effects[: len(share)] += np.where(crossing, np.nan_to_num(share), 0.0)
        return Truths(sure, possible, effects.T)


@dataclass(frozen=True, slots=True)
class Mode:
    """One way to draw an initial state, without discrete choices.

    Attributes:
        name: names of the situation and its branches, and the discrete values.
        weight: probability of the mode, before `where`.
        draws: programs of the assigned names, in order; they read coordinates and earlier names.
        coordinates: names of the coordinates, each from 0 to 1.
        conditions: the conditions of `where`; None if there are none.
    """

    name: str
    weight: float
    draws: tuple[tuple[str, ArrayProgram], ...] = field(repr=False)
    coordinates: tuple[str, ...]
    conditions: Conditions | None = field(default=None, repr=False)

    def states(self, at: Mapping[str, Array], names: Sequence[str], ops: Ops) -> list[Array]:
        """States with the given coordinates, one array per name in `names`, over any array library."""
        table: dict[str, Any] = dict(at)
        for name, program in self.draws:
            table[name] = program(table, ops)[name]
        return [table[name] for name in names]

    def truths(self, boxes: Sequence[Box], names: Sequence[str]) -> Truths:
        """Truth of the conditions over boxes."""
        assert self.conditions is not None
        states = self.states(corners(boxes, self.coordinates), names, FORMS)
        table = {name: spread(form, len(boxes)) for name, form in zip(names, states, strict=True)}
        return self.conditions.over(table, len(self.coordinates))


def modes_of(decl: InitDecl) -> list[Mode]:
    """Return all modes of a distribution of initial states; their weights sum to 1.

    Raises:
        Unsupported: a grid or a file of states, a sampler without bounded values, or too many modes.
    """
    total = sum(situation.weight for situation in decl.mixture)
    conditions = Conditions(decl.where) if decl.where else None
    found: list[Mode] = []
    for situation in decl.mixture:
        for names, share, draws in _paths(situation):
            assigns = (*decl.params, *draws, *decl.override, *decl.computed)
            found += _split(" / ".join(filter(None, names)), share / total, assigns, conditions)
    if len(found) > MOST_MODES:
        raise Unsupported(f"the initial states have {len(found)} discrete cases, more than {MOST_MODES}")
    return found


def _paths(situation: Situation) -> Iterator[tuple[tuple[str, ...], float, tuple[Assign, ...]]]:
    if situation.points is not None:
        raise Unsupported("initial states of a grid or a file are points, not boxes")
    if not situation.branches:
        yield (situation.name,), situation.weight, situation.draws
        return
    total = sum(branch.weight for branch in situation.branches)
    for number, branch in enumerate(situation.branches, start=1):
        for names, share, draws in _paths(branch):
            label = names if names[0] else (f"branch {number}", *names[1:])
            yield (situation.name, *label), situation.weight * share / total, (*situation.draws, *draws)


@dataclass(frozen=True, slots=True)
class _Outcome:
    """Discrete outcome of one assignment.

    Attributes:
        label: addition to the name of the mode.
        chance: its probability.
        num: the assigned number.
        axes: names of new coordinates.
    """

    label: str
    chance: float
    num: ir.Num
    axes: tuple[str, ...]


def _split(
    name: str, weight: float, assigns: Sequence[Assign], conditions: Conditions | None
) -> Iterator[Mode]:
    """Yield a mode for each combination of the discrete outcomes of the samplers in `assigns`."""
    partial: list[tuple[str, float, list[tuple[str, ir.Num]], tuple[str, ...]]] = [(name, weight, [], ())]
    for assign in assigns:
        partial = [
            (title + each.label, share * each.chance, [*draws, (assign.name, each.num)], axes + each.axes)
            for title, share, draws, axes in partial
            for each in _outcomes(assign, len(axes))
        ]
        if len(partial) > MOST_MODES:
            raise Unsupported(f"the initial states have more than {MOST_MODES} discrete cases")
    for title, share, draws, axes in partial:
        programs = tuple((key, ArrayProgram({key: num})) for key, num in draws)
        yield Mode(title, share, programs, axes, conditions)


def _outcomes(assign: Assign, taken: int) -> list[_Outcome]:
    """Discrete outcomes of one assignment; `taken` is the number of coordinates of earlier assignments."""
    axes: list[str] = []
    drawn: list[list[tuple[float, ir.Num]]] = []
    seen: dict[int, ir.Num] = {}

    def extract(num: ir.Num) -> ir.Num:
        if id(num) not in seen:  # one node of the tree is one draw, wherever it is used
            seen[id(num)] = replaced(num)
        return seen[id(num)]

    def replaced(num: ir.Num) -> ir.Num:
        if isinstance(num, ir.Op) and num.name == "uniform":
            first, last = map(extract, num.args)
            axes.append(f"#{taken + len(axes)}")
            return first + (last - first) * ir.Signal(axes[-1])
        options = _options(num, assign.name)
        if options is not None:
            drawn.append([(chance, extract(option)) for chance, option in options])
            return ir.Signal(f"?{len(drawn) - 1}")
        return num.map_parts(extract)

    num = extract(assign.value)
    found = []
    for outcome in product(*drawn):
        options = [option for _, option in outcome]
        chance = float(np.prod([share for share, _ in outcome]))
        label = ""
        if num == ir.Signal("?0") and options[0] in (ir.Const(0.0), ir.Const(1.0)):
            label = f", {assign.name}" if options[0] == ir.Const(1.0) else f", not {assign.name}"
        elif drawn:
            shown = (f"{each.value:g}" if isinstance(each, ir.Const) else "a number" for each in options)
            label = f", {assign.name}: {' '.join(shown)}"
        if chance > 0.0:
            table = {f"?{i}": option for i, option in enumerate(options)}
            found.append(_Outcome(label, chance, num.substitute(table), tuple(axes)))
    return found


def _options(num: ir.Num, name: str) -> list[tuple[float, ir.Num]] | None:
    """Values of a discrete sampler with their probabilities; None if `num` is no sampler."""
    match num:
        case ir.Op("bernoulli", (ir.Const(chance),)):
            return [(chance, ir.Const(1.0)), (1.0 - chance, ir.Const(0.0))]
        case ir.Op("randint", (ir.Const(low), ir.Const(high))):
            values = range(int(low), int(high) + 1)
            return [(1.0 / len(values), ir.Const(float(value))) for value in values]
        case ir.Op("choice", options):
            return [(1.0 / len(options), option) for option in options]
        case ir.Op("normal" | "truncnorm" | "randint" | "bernoulli" as sampler, _):
            raise Unsupported(f"`{sampler}` in `{name}` has no coordinate from 0 to 1")
        case _:
            return None
