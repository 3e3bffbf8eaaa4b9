"""In which order the components of a step are run over time.

A rollout need not take all components through one loop. Components are ordered by what they read: one that
depends only on earlier ones is computed for all steps at once, one that adds a known increment is a
cumulative sum, and only components that feed back into themselves are stepped, with everything that
does not change inside their loop computed before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from stlc.compile import ir
from stlc.dynamics.algebra import Hoist, names_in
from stlc.dynamics.step import Step

Lets: TypeAlias = Mapping[str, ir.Num]


@dataclass(frozen=True, slots=True)
class AtOnce:
    """Numbers of all steps, computed together; `columns` maps a state to the name of its next value."""

    outputs: Lets
    columns: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Accumulate:
    """A state that adds `increment` every step."""

    column: str
    increment: ir.Num


@dataclass(frozen=True, slots=True)
class Loop:
    """States that feed back into themselves.

    Attributes:
        early: computed before the loop, for all steps together.
        blocks: computed in every step, one after the other.
        columns: state -> name of its next value.
        lets: intermediate values that other stages read.
    """

    early: Lets
    blocks: tuple[Lets, ...]
    columns: Mapping[str, str]
    lets: tuple[str, ...]


Stage: TypeAlias = AtOnce | Accumulate | Loop


def schedule(step: Step) -> tuple[Stage, ...]:
    """The stages of a step, in an order in which each reads only states and numbers of earlier ones."""
    numbers = dict(step.lets) | {_next(name): num for name, num in step.next.items()}
    reads = {name: names_in(num) & (numbers.keys() | step.next.keys()) for name, num in numbers.items()}
    reads |= {name: frozenset((_next(name),)) for name in step.next}
    components = _components(reads)
    used: dict[str, set[str]] = {name: set() for name in reads}
    for reader, names in reads.items():
        for name in names:
            used[name].add(reader)
    return tuple(
        stage
        for index, group in enumerate(components)
        for stage in _stage(group, index, numbers, reads, used)
    )


def blocks(numbers: Lets) -> tuple[Lets, ...]:
    """Numbers in blocks of which each reads only earlier blocks."""
    level: dict[str, int] = {}
    for name, num in numbers.items():
        level[name] = 1 + max((level[other] for other in names_in(num) if other in level), default=-1)
    depth = max(level.values(), default=-1) + 1
    return tuple({name: numbers[name] for name in numbers if level[name] == at} for at in range(depth))


def _next(name: str) -> str:
    """How the next value of a state is called."""
    return f"{name}'"


def _stage(
    group: Sequence[str],
    index: int,
    numbers: Lets,
    reads: Mapping[str, frozenset[str]],
    used: Mapping[str, set[str]],
) -> tuple[Stage, ...]:
    """The stage of one strongly connected group of names."""
    inside = frozenset(group)
    states = {name: _next(name) for name in group if name not in numbers}
    if len(group) == 1:
        name = group[0]
        if name not in numbers:
            return (AtOnce({}, states),)
        if name not in reads[name]:
            return (AtOnce({name: numbers[name]}, {}),)
    body = {name: numbers[name] for name in numbers if name in inside}
    hoist = Hoist(inside, f"early{index}.")
    increment = _increment(states, body)
    if increment is not None:
        return (Accumulate(next(iter(states)), increment),)
    split = {name: hoist.split(num) for name, num in body.items()}
    wanted = tuple(name for name in body if name not in states.values() and used[name] - inside)
    return (Loop(hoist.early, blocks(split), states, wanted),)


def _increment(states: Mapping[str, str], body: Lets) -> ir.Num | None:
    """What is added every step, if that is all that happens to a single state."""
    if len(states) != 1 or len(body) != 1:
        return None
    (state,) = states
    (num,) = body.values()
    match num:
        case ir.Op("add", (ir.Col(name), increment)) if name == state and state not in names_in(increment):
            return increment
        case _:
            return None


def _components(reads: Mapping[str, frozenset[str]]) -> list[list[str]]:
    """Strongly connected components, dependencies first (Tarjan's algorithm, without recursion)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []
    for root in reads:
        path: list[tuple[str, Iterator[str]]] = (
            [] if root in order else [_enter(root, reads, order, low, stack)]
        )
        while path:
            name, rest = path[-1]
            other = next(rest, None)
            if other is None:
                path.pop()
                if path:
                    low[path[-1][0]] = min(low[path[-1][0]], low[name])
                if low[name] == order[name]:
                    at = stack.index(name)
                    found.append(stack[at:])
                    del stack[at:]
            elif other not in order:
                path.append(_enter(other, reads, order, low, stack))
            elif other in stack:
                low[name] = min(low[name], order[other])
    return found


def _enter(
    name: str,
    reads: Mapping[str, frozenset[str]],
    order: dict[str, int],
    low: dict[str, int],
    stack: list[str],
) -> tuple[str, Iterator[str]]:
    """Number a name that is seen for the first time."""
    order[name] = low[name] = len(order)
    stack.append(name)
    return name, iter(sorted(reads[name]))
