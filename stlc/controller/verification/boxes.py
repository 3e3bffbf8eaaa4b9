"""Boxes of initial states: the random numbers behind a draw as coordinates from 0 to 1.

An initial state is a function of uniform random numbers. A mode fixes everything discrete: the situation, its
branches, and the outcomes of `bernoulli` and `choice`. The probability of a mode times the volume of a box
is the probability of drawing a state in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.init import InitDecl, Situation
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.model.algebra import map_parts


class Unsupported(Exception):  # noqa: N818 - becomes a diagnostic
    """Error: a distribution of initial states that has no boxes; the message says why."""


@dataclass(frozen=True, slots=True)
class Mode:
    """One way to draw an initial state, without discrete choices.

    Attributes:
        name: names of the situation and its branches, and the discrete values.
        weight: probability of the mode.
        draws: programs of the assigned names, in order; they read coordinates and earlier names.
        coordinates: names of the coordinates, each from 0 to 1.
    """

    name: str
    weight: float
    draws: tuple[tuple[str, ArrayProgram], ...] = field(repr=False)
    coordinates: tuple[str, ...]

    def states(self, at: Mapping[str, Array], names: Sequence[str], ops: Ops) -> list[Array]:
        """States with the given coordinates, one array per name in `names`, over any array library."""
        table: dict[str, Any] = dict(at)
        for name, program in self.draws:
            table[name] = program(table, ops)[name]
        return [table[name] for name in names]


def modes_of(decl: InitDecl) -> list[Mode]:
    """Return all modes of a distribution of initial states; their weights sum to 1.

    Raises:
        Unsupported: a condition of `where`, a grid or a file of states, or a sampler without bounded values.
    """
    if decl.where:
        raise Unsupported("`where` rejects initial states, which has no boxes")
    total = sum(situation.weight for situation in decl.mixture)
    found = []
    for situation in decl.mixture:
        for names, share, draws in _paths(situation):
            assigns = (*decl.params, *draws, *decl.override)
            found += list(_split(" / ".join(filter(None, names)), share / total, assigns))
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


def _split(name: str, weight: float, assigns: Sequence[Assign]) -> Iterator[Mode]:
    """Yield a mode for each combination of the discrete outcomes of the samplers in `assigns`."""
    partial: list[tuple[str, float, list[tuple[str, ir.Num]], list[str]]] = [(name, weight, [], [])]
    for assign in assigns:
        partial = [
            (title + label, share * chance, [*draws, (assign.name, num)], [*axes, *new])
            for title, share, draws, axes in partial
            for label, chance, num, new in _outcomes(assign, len(axes))
        ]
    for title, share, draws, axes in partial:
        programs = tuple((key, ArrayProgram({key: num})) for key, num in draws)
        yield Mode(title, share, programs, tuple(axes))


def _outcomes(assign: Assign, taken: int) -> list[tuple[str, float, ir.Num, list[str]]]:
    """Discrete outcomes of one assignment: label, probability, assigned number, and new coordinates.

    `taken` is the number of coordinates of earlier assignments.
    """
    axes: list[str] = []
    chances: list[float] = []
    seen: dict[int, ir.Num] = {}

    def extract(num: ir.Num) -> ir.Num:
        if id(num) not in seen:  # one node of the tree is one draw, wherever it is used
            seen[id(num)] = replaced(num)
        return seen[id(num)]

    def replaced(num: ir.Num) -> ir.Num:
        match num:
            case ir.Op("uniform", (low, high)):
                first, last = extract(low), extract(high)
                axes.append(f"#{taken + len(axes)}")
                return ir.Op("add", (first, ir.Op("mul", (ir.Op("sub", (last, first)), ir.Signal(axes[-1])))))
            case ir.Op("bernoulli", (ir.Const(chance),)):
                chances.append(chance)
                return ir.Signal("?")
            case ir.Op("normal" | "truncnorm" | "randint" | "choice" | "bernoulli" as sampler, _):
                raise Unsupported(f"`{sampler}` in `{assign.name}` has no coordinate from 0 to 1")
            case _:
                return map_parts(num, extract)

    num = extract(assign.value)
    if not chances:
        return [("", 1.0, num, axes)]
    if len(chances) > 1 or num != ir.Signal("?"):
        raise Unsupported(f"`{assign.name}` is not one `bernoulli` alone")
    chance = chances[0]
    both = ((f", {assign.name}", chance, 1.0), (f", not {assign.name}", 1.0 - chance, 0.0))
    return [(label, share, ir.Const(value), []) for label, share, value in both if share > 0.0]
