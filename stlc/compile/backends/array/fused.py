"""Evaluation plan of a short trace in one call of C, where calls of NumPy would take most of the time.

`windows.c` has predicates with simple arithmetic, `and`, `or`, and `always` and `eventually` over future
windows, in the operations that NumPy does. Any other step leaves the plan to NumPy.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.batches import Batch, StepSource
from stlc.compile.backends.array.kernel import kernel_library
from stlc.compile.backends.schedule import PICKS, IndexRange, Instant, Schedule, ScheduleStep, neutral
from stlc.compile.ir import nodes as ir
from stlc.compile.namespace import Array

MOST = 1 << 14
"""Numbers of a signal beyond which calls take little of the time."""

_COPY, _ABS, _NEG, _ADD, _MUL, _PICK, _FILL, _WINDOW = range(8)
_STEP = struct.Struct("11qd")
"""Structure `Step` of `windows.c`."""

_BYTE, _FLOAT64 = ctypes.c_char * 1, np.dtype(np.float64)


class Place(NamedTuple):
    """Rows of an array from `row` on: 0 is working memory, 1 holds the results, the others are signals."""

    base: int
    row: Instant


_NUMBER = Place(-1, 0)
"""Second operand that is a number."""


@final
@dataclass(frozen=True, slots=True)
class Fused:
    """Plan in C.

    Attributes:
        columns: names of the signals.
        code: structures `Step`, one after the other.
        memory: rows of working memory.
        roots: rows of the results of each formula.
    """

    columns: tuple[str, ...]
    code: bytes
    memory: int
    roots: tuple[slice, ...]

    def run(self, env: Mapping[str, Array]) -> list[Array] | None:
        """Values of the formulas, (instants, batch) each; None if C cannot read the signals where they are.

        Raises:
            MemoryError: working memory cannot be allocated.
        """
        library, held = kernel_library("float64"), [env[name] for name in self.columns]
        shape = next(iter(env.values())).shape  # what the plan was made for
        if library is None or any(x.shape != shape or x.dtype != _FLOAT64 for x in held):
            return None
        out = np.empty((self.roots[-1].stop, shape[1]))
        try:
            places = [ctypes.addressof(_BYTE.from_buffer(x)) for x in (out, *held)]
        except (TypeError, ValueError, BufferError):  # an array that is read only, has gaps, or is empty
            return None
        bases = (ctypes.c_void_p * (len(places) + 1))(None, *places)
        steps, traces = len(self.code) // _STEP.size, shape[1]
        if library.run_all(self.code, steps, bases, self.memory, traces):
            raise MemoryError
        return [out] if len(self.roots) == 1 else [out[root] for root in self.roots]


class _NotFusedError(Exception):
    """A step that C does not have."""


@dataclass(slots=True)
class _Writer:
    """Writer of a plan in C.

    Attributes:
        plan: the steps.
        unknown: value of a predicate at an instant beyond the samples of an open trace.
        columns: signals that were read.
        code: steps that were written.
        memory: rows of working memory that were taken.
        found: places of the values of the steps.
    """

    plan: Schedule
    unknown: float
    columns: list[str] = field(default_factory=list)
    code: list[bytes] = field(default_factory=list)
    memory: int = 0
    found: list[Place] = field(default_factory=list)

    def room(self, rows: int) -> Place:
        """Take rows of working memory."""
        self.memory += rows
        return Place(0, self.memory - rows)

    def signal(self, name: str, first: Instant) -> Place:
        """Place of the samples of a signal from `first` on."""
        if name not in self.columns:
            self.columns.append(name)
        return Place(2 + self.columns.index(name), first)

    def emit(
        self,
        kind: int,
        to: Place,
        count: int,
        x: Place = _NUMBER,
        y: Place | float = 0.0,
        *,
        most: bool = False,
        window: Sequence[int] = (0, 0),
    ) -> None:
        """Write a step; `window` is the number of rows of the operand, and of a window."""
        rows, width = window
        place, number = (_NUMBER, y) if isinstance(y, float) else (y, 0.0)
        self.code.append(_STEP.pack(kind, most, rows, count, width, *x, *place, *to, number))

    def fill(self, to: Place, first: int, stop: int, value: float) -> None:
        """Write `value` to the rows from `first` up to `stop` of a place."""
        if stop > first:
            self.emit(_FILL, Place(to.base, to.row + first), stop - first, y=value)

    def program(self, program: ArrayProgram, run: IndexRange) -> dict[str, Place]:
        """Write a program at the instants `run`; return the places of its outputs."""
        code, outputs = program.instructions()
        if not program.plain or any(isinstance(output, float) for output in outputs.values()):
            raise _NotFusedError
        registers: dict[int, Place] = {}
        for register, instr in code.items():
            if instr.kernel == "input":
                registers[register] = self.signal(str(instr.params[0]), run.start)
                continue
            to = registers[register] = self.room(run.count)
            given = [registers[arg] if isinstance(arg, int) else arg for arg in instr.args]
            match instr.kernel, given, instr.params:
                case "abs" | "neg", [Place() as x], _:
                    self.emit(_ABS if instr.kernel == "abs" else _NEG, to, run.count, x)
                case "add" | "mul", [Place() as x, y], _:
                    self.emit(_ADD if instr.kernel == "add" else _MUL, to, run.count, x, y)
                case "sub", [Place() as x, float(number)], _:
                    self.emit(_ADD, to, run.count, x, -number)
                case "sub", [y, Place() as x], _:
                    self.emit(_NEG, to, run.count, x)
                    self.emit(_ADD, to, run.count, to, y)
                case "axpy", [Place() as x, Place() as y], [float(factor)]:
                    self.emit(_MUL, to, run.count, y, factor)
                    self.emit(_ADD, to, run.count, x, to)
                case _:
                    raise _NotFusedError
        return {name: registers[int(output)] for name, output in outputs.items()}

    def predicate(self, step: ScheduleStep, inside: IndexRange, known: Place) -> Place:
        """Write a predicate with values at the instants `inside`; return the place of those of the step."""
        count, before = step.run.count, inside.start - step.run.start
        if step.node.guard:
            raise _NotFusedError
        if inside.count == count:
            return known
        outside = self.unknown if self.plan.domain.open else -step.node.sign * math.inf
        to, stop = self.room(count), before + inside.count
        self.fill(to, 0, before, outside)
        if inside.count > 0:
            self.emit(_COPY, Place(to.base, to.row + before), inside.count, known)
        self.fill(to, stop, count, outside)
        return to

    def formula(self, step: ScheduleStep) -> Place:
        """Write the step of a formula that is no predicate; return the place of its values."""
        node, count, domain = step.node, step.run.count, self.plan.domain
        to, parts = self.room(count), [self.found[each] for each in step.operands]
        rows = self.plan.steps[step.operands[0]].run.count if parts else 0
        match node:
            case ir.Truth(value):
                self.fill(to, 0, count, math.inf if value else -math.inf)
            case ir.BoolOp(op):
                left = parts[0]
                for right in parts[1:]:
                    self.emit(_PICK, to, count, left, right, most=PICKS[op] == "max")
                    left = to
                return left
            case ir.Temporal(op, window):
                stop, beyond = count, neutral(PICKS[op])
                if domain.open and window.hi is None:
                    stop, beyond = min(count, domain.length - window.lo - step.run.start), self.unknown
                stop = max(stop, 0) if parts else 0
                windows = min(stop, rows)
                width = rows if window.hi is None else min(window.hi - window.lo + 1, rows)
                if windows:
                    shape = (rows, width)
                    self.emit(_WINDOW, to, windows, parts[0], most=PICKS[op] == "max", window=shape)
                self.fill(to, windows, stop, neutral(PICKS[op]))
                self.fill(to, stop, count, beyond)
            case _:
                raise _NotFusedError
        return to


def fused(
    plan: Schedule, batches: Sequence[Batch], sources: Mapping[int, StepSource], unknown: float
) -> Fused | None:
    """Return the plan in C; None if it has a step that C does not have.

    Args:
        plan: the steps.
        batches: programs of the predicates.
        sources: number of a predicate's step -> source of its values.
        unknown: value of a predicate at an instant beyond the samples of an open trace.
    """
    writer, roots, rows = _Writer(plan, unknown), [], 0
    try:
        programs = [writer.program(batch.program, batch.run) for batch in batches]
        for step in plan.steps:
            source = sources.get(step.number)
            if not isinstance(step.node, ir.Predicate):
                place = writer.formula(step)
            elif source is None:
                place = writer.predicate(step, IndexRange(step.run.start, step.run.start - 1), _NUMBER)
            elif source.batch is None:
                place = writer.predicate(step, source.inside, writer.signal(source.name, source.inside.start))
            else:
                base, row = programs[source.batch][source.name]
                row += source.inside.start - batches[source.batch].run.start
                place = writer.predicate(step, source.inside, Place(base, row))
            writer.found.append(place)
    except _NotFusedError:
        return None
    for root in plan.roots:
        count = plan.steps[root].run.count
        writer.emit(_COPY, Place(1, rows), count, writer.found[root])
        roots.append(slice(rows, rows + count))
        rows += count
    made = Fused(tuple(writer.columns), b"".join(writer.code), writer.memory, tuple(roots))
    return made if made.columns else None
