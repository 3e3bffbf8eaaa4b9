"""What a program reads at consecutive instants: columns cut to them, and columns of samples beside them."""

from __future__ import annotations

from collections.abc import Mapping

from stlc.compile.backends.array.arith import Program
from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.ir import nodes as ir
from stlc.compile.schedule.schedule import Run


def inputs(program: Program, env: Mapping[str, Array], run: Run, ops: Ops) -> dict[str, Array]:
    """The inputs of `program` at the instants `run`, each `(count, batch)`; at least one column.

    Args:
        program: at these instants all samples that it reads exist.
        env: whole columns, `(time, batch)`.
        run: within the trace.
        ops: the array library of `env`.
    """

    def read(name: str) -> Array:
        if name == ir.ELAPSED:
            return ops.counted(run.start, run.count, next(iter(env.values())))
        if name in program.shifted:
            return _beside(env[program.shifted[name].name], program.shifted[name], run, ops)
        return _cut(env[name], run.start, run.count)

    return {name: read(name) for name in program.columns or list(env)[:1]}


def _cut(column: Array, start: int, count: int) -> Array:
    return column if start == 0 and len(column) == count else column[start : start + count]


def _beside(column: Array, at: ir.ShiftedSignal, run: Run, ops: Ops) -> Array:
    """The column some samples later; a clamped one repeats its first and last row beyond the ends."""
    start, count, samples = run.start + at.steps, run.count, len(column)
    before, after = min(max(-start, 0), count), min(max(start + count - samples, 0), count)
    if not before and not after:
        return _cut(column, start, count)
    inside = [column[max(start, 0) : min(start + count, samples)]] if before + after < count else []
    return ops.cat([*[column[:1]] * before, *inside, *[column[-1:]] * after])
