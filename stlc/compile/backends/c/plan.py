"""Evaluation schedule of formulas with memory for all values; the C code is printed from this schedule.

A `freeze` is computed in a loop over its instants. Sub-formulas that do not read the frozen values are
computed before the loop. Requirements that differ in parameters only are computed in a loop over a table of
the parameters (`families`). The same holds for operands of `and` and `or`. A function call with signals as
arguments, such as `f(x, y)`, is computed once, for all samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TypeAlias

from stlc.compile.backends.c.families import Family, FamilyTable, families
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.backends.schedule import (
    PICKS,
    End,
    IndexRange,
    Instant,
    LoopIndex,
    Schedule,
    Scheduler,
    ScheduleStep,
    StepScope,
    TraceDomain,
    earliest,
    latest,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.namespace import Pick

CallKey: TypeAlias = tuple[str, tuple[ir.Signal, ...]]


@dataclass(frozen=True, slots=True)
class Buffer:
    """Memory for the values of a sub-formula at consecutive instants, for `LANES` trajectories side by side.

    Attributes:
        name: name of the C array.
        origin: instant of the first row.
        rows: number of instants.
        place: offset of the array in the working memory, in doubles per trajectory.
    """

    name: str
    origin: int
    rows: int
    place: int

    def __getitem__(self, instant: Instant | str) -> str:
        """Return the C expression of the value at an instant, for trajectory `j`."""
        offset = f" - {self.origin}" if self.origin > 0 else f" + {-self.origin}" if self.origin else ""
        return f"{self.name}[{instant}{offset}][j]"


@dataclass(frozen=True, slots=True)
class Called:
    """Step that evaluates a function of signals at all samples.

    The function may return several values. They have consecutive step numbers: the first value has the number
    of this step.
    """

    function: ir.Extern

    @property
    def components(self) -> list[ir.Extern]:
        """The components of the function's result, as expressions."""
        assert isinstance(self.function.function, ir.Body)
        outputs = range(len(self.function.function.outputs))
        return [replace(self.function, output=output) for output in outputs]


@dataclass(frozen=True, slots=True)
class Loop:
    """Body of a C loop.

    Attributes:
        index: C name of the loop index.
        steps: steps that are computed in every iteration.
        own: step numbers of all values that an iteration overwrites, in order of allocation.
        root: number of the step whose value is the result of an iteration.
    """

    index: str
    steps: tuple[ScheduleStep, ...]
    own: tuple[int, ...]
    root: int


@dataclass(frozen=True, slots=True)
class Frozen:
    """Step that evaluates a `freeze`: a loop over its instants.

    Attributes:
        node: the `freeze` formula.
        bound: step numbers of the frozen values, in the order of their bindings.
        loop: body of the loop.
    """

    node: ir.Freeze
    bound: tuple[int, ...]
    loop: Loop


@dataclass(frozen=True, slots=True)
class Tabled:
    """Step that evaluates a family of formulas (which differ in parameters only): a loop over its table.

    Attributes:
        table: parameters of each row.
        pick: minimum or maximum over the rows at each instant. If None, no extremum is taken: the step has
            one value per row, the value at the first sample.
        loop: body of the loop.
    """

    table: FamilyTable
    pick: Pick | None
    loop: Loop


@dataclass(frozen=True, slots=True)
class Storage:
    """Location of one value in memory: a row of a buffer."""

    buffer: Buffer
    row: int


@dataclass(frozen=True, slots=True)
class Plan:
    """Evaluation schedule with the memory of its steps.

    Attributes:
        schedule: steps (sub-formulas at ranges of instants) in the order of computation.
        roots: location of each formula's robustness at the first sample.
        buffers: memory of each step, by step number.
        size: working memory in doubles per trajectory.
        calls: key of a function call on signals (`call_of`) -> step number of the first component of its
            result.
    """

    schedule: Schedule
    roots: tuple[Storage, ...]
    buffers: tuple[Buffer, ...]
    size: int
    calls: Mapping[CallKey, int]

    @property
    def samples(self) -> int:
        """Number of samples of a trajectory, T + 1."""
        return self.schedule.domain.samples


def plan_of(formulas: Sequence[ir.Formula], samples: int, end: End = "strict") -> Plan:
    """Return the schedule that evaluates `formulas` at the first sample of a trajectory.

    The schedule includes the memory of its steps. The trajectory has `samples` samples. With `end`
    "truncate", windows are cut at the last sample.

    Raises:
        Untranslatable: a formula needs samples outside of the trajectory.
    """
    planner = _Planner(TraceDomain(samples, end))
    places = planner.roots(formulas)
    numbers = tuple(number for number, _ in places)
    schedule = Schedule(planner.domain, tuple(planner.scope.steps), numbers)
    roots = tuple(Storage(planner.buffers[number], row) for number, row in places)
    return Plan(schedule, roots, tuple(planner.buffers), planner.size, planner.calls)


@dataclass(slots=True)
class _Scope(StepScope):
    """Group of steps: the whole schedule, the body of a `freeze`, or the body of a loop over a table.

    Attributes:
        read: names of the values that the steps may read and that change from iteration to iteration; empty
            for the whole schedule.
        table: whether the group is the body of a loop over a table.
        own: numbers of the steps in the group.
    """

    read: frozenset[str] = frozenset()
    table: bool = False
    own: list[int] = field(default_factory=list)


_FIRST = IndexRange(0, 0)


class _Planner(Scheduler):
    def __init__(self, domain: TraceDomain) -> None:
        super().__init__(domain)
        self.scope: _Scope = _Scope()
        self.scopes = [self.scope]
        self.buffers: list[Buffer] = []
        self.size = 0
        self.calls: dict[CallKey, int] = {}
        self._loops = 0

    def place(self, node: ir.Formula, run: IndexRange) -> int | None:
        """Return the number of the step that computes `node` at the instants `run`; None if `run` is empty.

        If there is no such step yet, it is added, outside of all loops on which its value does not depend.
        """
        node, depth = _split(node), 0
        if len(self.scopes) > 1:  # depth of the innermost enclosing loop on which the value depends
            read = _frozen_names(node)
            depth = max((i for i, scope in enumerate(self.scopes) if read & scope.read), default=0)
        around = self.scopes[depth + 1 :]
        if not around:
            return super().place(node, run)
        frozen = any(not scope.table for scope in around)
        with self._inside(self.scopes[: depth + 1]):
            return self.place(node, run.settled if frozen else run)

    def number(self, run: IndexRange) -> int:
        """Return the next step number, and reserve memory for the values of that step at `run`."""
        buffer = Buffer(f"b{len(self.buffers)}", earliest(run.start), run.count, self.size)
        self.buffers.append(buffer)
        self.size += buffer.rows
        self.scope.own.append(number := super().number(run))
        return number

    @contextmanager
    def _inside(self, scopes: list[_Scope]) -> Iterator[_Scope]:
        """Context manager in which new steps are added to the last of `scopes`, the innermost one."""
        before = self.scopes
        self.scopes, self.scope = scopes, scopes[-1]
        try:
            yield self.scope
        finally:
            self.scopes, self.scope = before, before[-1]

    def scheduled(self, node: ir.Formula, run: IndexRange) -> int:
        """Add the step that computes the formula `node` at the instants `run`; return the step's number.

        Raises:
            Untranslatable: the formula needs samples outside of the trajectory.
        """
        match node:
            case ir.Predicate(num):
                self._check(num, run)
            case ir.BoolOp(op, items):
                return self._join(node, PICKS[op], _operands(op, items), run)
            case ir.Windowed(window=window, back=False) if self.domain.end == "strict":
                most = latest(run.last) + max(window.lo, window.hi or 0)
                if most >= self.domain.samples:
                    raise Untranslatable("a window that leaves the plan")
            case ir.Shift(steps, _, None):  # also refused where windows are cut: it has no window
                if earliest(run.start) + steps < 0 or latest(run.last) + steps >= self.domain.samples:
                    raise Untranslatable("a sample outside of the plan")
            case ir.Freeze():
                return self._freeze(node, run)
        return super().scheduled(node, run)

    def roots(self, formulas: Sequence[ir.Formula]) -> list[tuple[int, int]]:
        """Add the steps that compute formulas at the first sample.

        Returns for each formula the number of its step, and a row in the values of this step. The formulas of
        a family (which differ in parameters only) are the rows of one step. Any other formula is row 0 of its
        own step.
        """
        places: dict[int, tuple[int, int]] = {}
        for family in self._families(list(map(_split, formulas))):
            number = self._tabled(family, _FIRST, None)
            places.update((member, (number, row)) for row, member in enumerate(family.members))
        for i, formula in enumerate(formulas):
            if i not in places:
                places[i] = self._needed(formula, _FIRST), 0
        return [places[i] for i in range(len(formulas))]

    def _needed(self, formula: ir.Formula, run: IndexRange) -> int:
        number = self.place(formula, run)
        assert number is not None
        return number

    def _join(self, node: ir.BoolOp, pick: Pick, items: Sequence[ir.Formula], run: IndexRange) -> int:
        """Add the step that computes `and` as a minimum or `or` as a maximum; return the step's number.

        Operands that differ in parameters only (a family) are computed by one step, as a loop over a table.
        """
        found = self._families(items)
        loops = {family.members[0]: family for family in found}
        taken = {member for family in found for member in family.members[1:]}
        args = tuple(
            self._tabled(loops[i], run, pick) if i in loops else self._needed(item, run)
            for i, item in enumerate(items)
            if i not in taken
        )
        return args[0] if len(args) == 1 else self.add(ScheduleStep(node, run, args, number=self.number(run)))

    def _families(self, formulas: Sequence[ir.Formula]) -> list[Family]:
        found = families(formulas, self._loops + 1)
        self._loops += len(found)
        return found

    def _tabled(self, family: Family, run: IndexRange, pick: Pick | None) -> int:
        table = family.table
        number = self.number(run if pick else IndexRange(0, table.rows - 1))
        with self._inside([*self.scopes, _Scope(read=table.names, table=True)]) as inner:
            root = self._needed(family.shape, run)
        self._loops += 1
        loop = Loop(f"p{self._loops}", tuple(inner.steps), tuple(inner.own), root)
        return self.add(ScheduleStep(Tabled(table, pick, loop), run, (), number))

    def _freeze(self, node: ir.Freeze, run: IndexRange) -> int:
        for _, num in node.bindings:
            self._check(num, run)
        self._loops += 1
        now = LoopIndex(f"f{self._loops}", earliest(run.start), latest(run.last))
        number, read = self.number(run), frozenset(name for name, _ in node.bindings)
        with self._inside([*self.scopes, _Scope(read=read)]) as inner:
            bound = tuple(self.number(_FIRST) for _ in node.bindings)
            root = self._needed(node.body, IndexRange(now, now))
        loop = Loop(now.text, tuple(inner.steps), tuple(inner.own), root)
        return self.add(ScheduleStep(Frozen(node, bound, loop), run, (), number))

    def _check(self, num: ir.Num, run: IndexRange) -> None:
        """Check that an expression is defined at the instants `run`, and schedule the function calls in it.

        Raises:
            Untranslatable: the expression needs samples outside of the trajectory.
        """
        past, future = num.reach
        if earliest(run.start) < past or latest(run.last) + future >= self.domain.samples:
            raise Untranslatable("a sample outside of the plan")
        for part in num.subexpressions():
            key = call_of(part)
            if key is not None and key not in self.calls:
                assert isinstance(part, ir.Extern)
                whole = IndexRange(0, self.domain.samples - 1)
                called = Called(replace(part, args=key[1], output=0))
                with self._inside(self.scopes[:1]):
                    first, *_ = [self.number(whole) for _ in called.components]
                    self.calls[key] = self.add(ScheduleStep(called, whole, (), number=first))


def call_of(num: ir.Num) -> CallKey | None:
    """Key that identifies a function call on signals: (function name, signals).

    Calls with equal keys are computed once, for all samples. The result is None if `num` is not such a call,
    or if its signals are read at different samples.
    """
    if not isinstance(num, ir.Extern) or not isinstance(num.function, ir.Body):
        return None
    leaves = [arg for arg in num.args if isinstance(arg, (ir.Signal, ir.ShiftedSignal))]
    shifts = {(arg.steps, arg.clamped) if isinstance(arg, ir.ShiftedSignal) else (0, False) for arg in leaves}
    if len(leaves) < len(num.args) or len(shifts) > 1:
        return None
    return num.name, tuple(ir.Signal(leaf.name) for leaf in leaves)


def _frozen_names(formula: ir.Formula) -> frozenset[str]:
    """Names of the signals and frozen values that a formula reads.

    A frozen value is one that a `freeze` around the formula binds.
    """
    match formula:
        case ir.Predicate(num):
            return num.frozen | num.columns
        case ir.Freeze(bindings, body):
            inner = _frozen_names(body) - {name for name, _ in bindings}
            return inner.union(*(num.frozen | num.columns for _, num in bindings))
        case _:
            return frozenset().union(*map(_frozen_names, formula.operands))


LARGE = 64
"""Size in nodes from which the operands of an extremum are separate steps, to limit compile time."""


def _split(formula: ir.Formula) -> ir.Formula:
    """Rewrite a predicate over a large `min` or `max` as `and` or `or` of predicates.

    An expression is large if it has more than `LARGE` nodes. Any other formula is returned unchanged.
    """
    if not isinstance(formula, ir.Predicate) or formula.guard or not isinstance(formula.num, ir.Op):
        return formula
    if next(islice(formula.num.subexpressions(), LARGE, None), None) is None:
        return formula
    num = _distributed(formula.num)
    name, args = num.name, num.args
    if name not in ("min", "max", "neg"):
        return formula
    if name == "neg":
        return _split(replace(formula, num=args[0], sign=-formula.sign, strict=formula.strict))
    if len(args) == 1:
        return _split(replace(formula, num=args[0]))
    both = (name == "min") == (formula.sign > 0)
    return ir.BoolOp("and" if both else "or", tuple(replace(formula, num=arg) for arg in args), formula.span)


def _distributed(num: ir.Op) -> ir.Op:
    """Rewrite `min(a, b) + c` as `min(a + c, b + c)`; `max` and differences are rewritten accordingly.

    The values are equal bit for bit, since rounding is monotone. Any other expression is returned unchanged.
    """
    if num.name not in ("add", "sub") or len(num.args) != 2:
        return num
    for i, part in enumerate(num.args):
        other = num.args[1 - i]
        if (
            isinstance(part, ir.Op)
            and part.name in ("min", "max")
            and isinstance(other, ir.Const | ir.Signal | ir.FrozenVar)
        ):
            name = part.name
            if num.name == "sub" and i == 1:
                name = "max" if name == "min" else "min"
            sums = [tuple((arg, other) if i == 0 else (other, arg)) for arg in part.args]
            return ir.Op(name, tuple(ir.Op(num.name, pair) for pair in sums))
    return num


def _operands(op: str, items: Sequence[ir.Formula]) -> list[ir.Formula]:
    """Operands of an `and` or `or`, including the operands of nested operators of the same kind."""
    found: list[ir.Formula] = []
    for item in map(_split, items):
        found += _operands(op, item.items) if isinstance(item, ir.BoolOp) and item.op == op else [item]
    return found
