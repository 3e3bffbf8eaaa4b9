"""Order in which the states and intermediate results of a step are computed in a rollout.

Not all states need a loop over time. States are ordered by dependencies. A state that depends only on earlier
ones is computed for all steps at once. A state that changes by a known increment is a cumulative sum. Only
states that depend on themselves in another way are computed in a loop over the steps. Values that are
constant in that loop, or known for all steps, are computed before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import mul
from typing import TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.dynamics.model.step import ModelStep

Lets: TypeAlias = Mapping[str, ir.Num]


@dataclass(frozen=True, slots=True)
class RolloutStage:
    """States and expressions that can be computed together after the earlier stages.

    Attributes:
        early: name -> expression computed for all steps at once, before the rest of the stage.
        follows: state -> name of the expression that gives its next value. The expression is in `early`,
            of this stage or of an earlier one.
        sums: state -> name of the expression in `early` that gives its increment per step.
        blocks: expressions computed in a loop over the steps; each block reads only earlier blocks.
        stepped: state -> name of the expression in `blocks` that gives its next value.
        lets: names of expressions in `blocks` that later stages read.
    """

    early: Lets
    follows: Mapping[str, str]
    sums: Mapping[str, str]
    blocks: tuple[Lets, ...]
    stepped: Mapping[str, str]
    lets: tuple[str, ...]


def schedule(step: ModelStep) -> tuple[RolloutStage, ...]:
    """Split a step into stages, in the order of computation.

    A stage reads only its own states and expressions, and those of earlier stages.
    """
    numbers = step.numbers
    reads = {name: num.columns & (numbers.keys() | step.next.keys()) for name, num in numbers.items()}
    reads |= {name: frozenset((f"{name}'",)) for name in step.next}
    level: dict[str, int] = {}
    groups: list[list[list[str]]] = []
    for group in _components(reads):
        before = [level[name] for member in group for name in reads[member] if name in level]
        alone_state = len(group) == 1 and group[0] not in numbers
        depth = max(before, default=-1) + (not alone_state)
        level |= dict.fromkeys(group, depth)
        if depth == len(groups):
            groups.append([])
        groups[depth].append(group)
    writers = [_StageWriter(numbers, reads, depth) for depth in range(len(groups))]
    for writer, members in zip(writers, groups, strict=True):
        for group in members:
            writer.add(group)
    return tuple(writer.stage() for writer in writers)


class _StageWriter:
    """Builder of one stage: states and expressions that are computed together.

    A group consists of names that depend on each other. Groups are added one by one. A stage takes all groups
    at the same depth of the dependency graph, so no group depends on another group of the stage.
    """

    def __init__(self, numbers: Lets, reads: Mapping[str, frozenset[str]], depth: int) -> None:
        self.numbers = numbers
        self.reads = reads
        self.prefix = f"early{depth}."
        self.early: dict[str, ir.Num] = {}
        self.follows: dict[str, str] = {}
        self.sums: dict[str, str] = {}
        self.stepped: dict[str, str] = {}
        self.body: dict[str, ir.Num] = {}
        self.lets: list[str] = []

    def add(self, group: Sequence[str]) -> None:
        """Add one group of states and expressions that depend on each other.

        A group is a strongly connected component of the dependency graph, often a single name.
        """
        name = group[0]
        if len(group) == 1 and name not in self.reads[name]:
            if name in self.numbers:
                self.early[name] = self.numbers[name]
            else:
                self.follows[name] = f"{name}'"
            return
        inside = frozenset(group)
        states = {name: f"{name}'" for name in group if name not in self.numbers}
        body = {name: num for name, num in self.numbers.items() if name in inside}
        increment = _increment(states, body)
        if increment is not None:
            (state,) = states
            self.sums[state] = f"{state}+"
            self.early[f"{state}+"] = increment
            return
        hoist = Hoist(inside, self.prefix, self.early)
        self.body |= {name: hoist.split(num) for name, num in body.items()}
        self.stepped |= states
        read_outside = {
            name for reader, names in self.reads.items() if reader not in inside for name in names
        }
        self.lets += [name for name in body if name in read_outside]

    def stage(self) -> RolloutStage:
        """Return the stage that holds all groups added."""
        return RolloutStage(
            self.early, self.follows, self.sums, blocks(self.body), self.stepped, tuple(self.lets)
        )


def blocks(numbers: Lets) -> tuple[Lets, ...]:
    """Split named expressions into blocks, each of which reads only names of earlier blocks."""
    level: dict[str, int] = {}
    for name, num in numbers.items():
        level[name] = 1 + max((level[other] for other in num.columns if other in level), default=-1)
    depth = max(level.values(), default=-1) + 1
    return tuple({name: numbers[name] for name in numbers if level[name] == at} for at in range(depth))


def _increment(states: Mapping[str, str], body: Lets) -> ir.Num | None:
    """Return the increment of the only state in `states` if its next value is `state + increment`.

    Returns None if `states` or `body` has several entries, if the next value has another form, or if the
    increment depends on the state.

    Args:
        states: states that are computed together -> name of the expression of the next value.
        body: these expressions by name.
    """
    if len(states) != 1 or len(body) != 1:
        return None
    (state,) = states
    (num,) = body.values()
    match num:
        case ir.Op("add", (ir.Signal(name), added)) if name == state and state not in added.columns:
            return added
        case _:
            return None


def _components(reads: Mapping[str, frozenset[str]]) -> list[list[str]]:
    """Strongly connected components of the graph `reads`, dependencies first.

    This is Tarjan's algorithm without recursion.
    """
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []
    path: list[tuple[str, Iterator[str]]] = []

    def enter(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        path.append((name, iter(sorted(reads[name]))))

    for root in reads:
        if root not in order:
            enter(root)
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
                enter(other)
            elif other in stack:
                low[name] = min(low[name], order[other])
    return found


# ------------------------------------------------------------------------------ hoisting


@dataclass
class Hoist:
    """Rewriter that moves loop-invariant parts of numeric expressions out of a loop.

    Attributes:
        moving: names that change within the loop.
        early: name -> loop-invariant expression to be computed before the loop; each call of `split` adds
            entries.
        prefix: prefix of the generated names.
    """

    moving: frozenset[str]
    prefix: str
    early: dict[str, ir.Num] = field(default_factory=dict)

    def split(self, num: ir.Num) -> ir.Num:
        """Replace the largest loop-invariant parts of `num` by names, and add these parts to `early`."""
        if not num.columns & self.moving:
            return self._steady(num)
        match num:
            case ir.Op("add" | "sub" | "neg"):
                return self._sum(num)
            case ir.Op("mul"):
                return self._product(num)
            case ir.Where(cond, yes, no) if not cond.columns & self.moving:
                # It stays a choice: a product with 0 is NaN where the branch not taken is not finite.
                return cond.map_parts(self._steady).select(self.split(yes), self.split(no))
            case _:
                return num.map_parts(self.split)

    def _steady(self, num: ir.Num) -> ir.Num:
        """Add a loop-invariant expression to `early`, and return the name that stands for it.

        `early` is computed once, before the loop. Constants and columns are returned unchanged.
        """
        if isinstance(num, ir.Const | ir.Signal):
            return num
        for name, known in self.early.items():
            if known == num:
                return ir.Signal(name)
        name = f"{self.prefix}{len(self.early)}"
        self.early[name] = num
        return ir.Signal(name)

    def _sum(self, num: ir.Num) -> ir.Num:
        """Rewrite a sum: its loop-invariant terms are combined into one expression in `early`."""
        terms = _terms(num)
        moving = [(sign, self.split(term)) for sign, term in terms if term.columns & self.moving]
        steady = [(sign, term) for sign, term in terms if not term.columns & self.moving]
        constant = sum(sign * term.value for sign, term in steady if isinstance(term, ir.Const))
        variable = [(sign, term) for sign, term in steady if not isinstance(term, ir.Const)]
        total = _signed_sum(moving)
        rest = _signed_sum(variable) if variable else ir.Const(constant)
        if variable and constant != 0.0:
            rest = rest + constant
        return total if rest == ir.Const(0.0) else total + self._steady(rest)

    def _product(self, num: ir.Num) -> ir.Num:
        """Rewrite a product: its loop-invariant factors are combined into one expression in `early`."""
        factors = _factors(num)
        moving = [self.split(factor) for factor in factors if factor.columns & self.moving]
        steady = [factor for factor in factors if not factor.columns & self.moving]
        result = reduce(mul, moving)
        return result * self._steady(reduce(mul, steady)) if steady else result


def _terms(num: ir.Num, sign: int = 1) -> list[tuple[int, ir.Num]]:
    """Return the terms of a sum as pairs (sign, term), with sign 1 or -1. Nested sums are expanded."""
    match num:
        case ir.Op("add", (left, right)):
            return [*_terms(left, sign), *_terms(right, sign)]
        case ir.Op("sub", (left, right)):
            return [*_terms(left, sign), *_terms(right, -sign)]
        case ir.Op("neg", (operand,)):
            return _terms(operand, -sign)
        case _:
            return [(sign, num)]


def _factors(num: ir.Num) -> list[ir.Num]:
    """Return the factors of a product, nested products expanded."""
    match num:
        case ir.Op("mul", (left, right)):
            return [*_factors(left), *_factors(right)]
        case _:
            return [num]


def _signed_sum(terms: Sequence[tuple[int, ir.Num]]) -> ir.Num:
    """Return the sum of (sign, term) pairs, with the positive terms first."""
    (sign, total), *rest = sorted(terms, key=lambda pair: pair[0] < 0)
    total = total if sign > 0 else -total
    for sign, term in rest:
        total = total.apply("add" if sign > 0 else "sub", term)
    return total
