"""Robustness of a formula on a trace, at the instants at which a requirement is evaluated."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.defined import defined
from stlc.compile.ir.support import columns_of, history
from stlc.compile.ir.traverse import map_children, subexpressions
from stlc.compile.schedule.schedule import Boundary
from stlc.compile.semantics.semantics import Exact, Semantics
from stlc.monitor.holes import holes_in, partial, unsure, without_holes

Ends: TypeAlias = Literal["open", "truncate"]
"""`open`: the trace may continue, values are bounds over all continuations; `truncate`: windows are cut."""

_CHUNK = 1 << 22
"""Numbers of one column per block when windows are unrolled."""


@dataclass(frozen=True, slots=True)
class Record:
    """Signals of traces, `(samples, batch)`, and their array library.

    Attributes:
        env: signal name -> values, none of them NaN.
        ops: the array library.
        semantics: definition of minimum and maximum.
        holes: names of the signals with unknown values (`stlc.monitor.holes`).
        computed: whether NaN that a function gives outside of its domain is unknown too.
    """

    env: Mapping[str, Array]
    ops: Ops
    semantics: Semantics = Exact()  # noqa: RUF009 - frozen
    holes: frozenset[str] = frozenset()
    computed: bool = False

    @staticmethod
    def of(env: Mapping[str, Array], ops: Ops) -> Record:
        """Return a record of the signals `env`; in NumPy arrays, NaN is an unknown value."""
        holes = holes_in(env) if ops is NUMPY else frozenset[str]()
        return Record(without_holes(env, holes) if holes else env, ops, holes=holes, computed=ops is NUMPY)

    @property
    def sure(self) -> Record:
        """Copy of this record in which nothing counts as unknown.

        Formulas that account for unknown values themselves are evaluated on this copy.
        """
        return replace(self, holes=frozenset(), computed=False)

    def sides(self, formula: ir.Formula) -> tuple[ir.Formula, ir.Formula]:
        """Return two formulas, for a lower and an upper bound on `formula`, to be evaluated on `sure`.

        Both are `formula` itself if no value that it reads can be unknown.
        """
        if not self.holes and not (self.computed and partial(formula)):
            return formula, formula
        least = unsure(formula, self.holes, least=True, computed=self.computed)
        most = unsure(formula, self.holes, least=False, computed=self.computed)
        return (formula, formula) if least == most else (least, most)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(next(iter(self.env.values())))

    def cut(self, stop: int) -> Record:
        """Return a record of the first `stop` samples."""
        return self if stop >= self.samples else replace(self, env={n: x[:stop] for n, x in self.env.items()})

    def values(
        self, formulas: Sequence[ir.Formula], instants: range, end: Boundary, stop: int | None = None
    ) -> list[Array]:
        """Values of each formula at `instants`, `(instants, batch)`.

        `end` is the treatment of windows that extend beyond the last sample: "strict" gives NaN, "truncate"
        clips them, "lower" and "upper" give a bound. If the trace continues, `stop` is the number of samples
        in the complete trace. Unbounded windows then extend to the end of the complete trace.
        """
        return evaluate(
            formulas,
            self.env,
            ops=self.ops,
            semantics=self.semantics,
            start=instants.start,
            count=len(instants),
            end=end,
            stop=stop,
        )


def bounds(
    formula: ir.Formula, record: Record, starts: range, ends: Ends, stop: int | None = None
) -> tuple[Array, Array]:
    """Least and greatest values at consecutive instants, each `(count, batch)`.

    If nothing is unknown, the same array is returned twice. `ends` is the treatment of windows that extend
    beyond the trace: "open" computes bounds, "truncate" clips the windows. `stop` is the number of samples in
    the complete trace, if the record contains fewer.
    """
    least, most = record.sides(formula)
    end: Boundary | None = "truncate" if ends == "truncate" else None
    stop = None if end is not None or stop is None or stop <= record.samples else stop
    if end is None and stop is None and defined(formula, record.samples)[starts.start : starts.stop].all():
        end = "strict"
    if end is None:
        (low,) = record.values([least], starts, "lower", stop)
        (high,) = record.values([most], starts, "upper", stop)
        return low, high
    if least is most:
        (value,) = record.values([formula], starts, end)
        return value, value
    low, high = record.values([least, most], starts, end)
    return low, high


def window_bounds(
    formula: ir.Formula, record: Record, starts: range, window: int, ends: Ends
) -> tuple[Array, Array]:
    """Least and greatest values of a formula whose `end` moves with the instant, each `(count, batch)`.

    `end` is `window` samples after each instant. Each instant is evaluated on its own excerpt of the trace.
    The excerpt begins before the instant, so that past operators find their samples, and stops at `end`. Many
    excerpts form one batch. If the trace is too short for an excerpt, the missing samples are unknown. If
    `ends` is "truncate", the excerpt stops at the last sample instead.
    """
    back = history(formula)
    early = range(starts.start, max(min(back, starts.stop), starts.start))
    pairs = [bounds(formula, record.cut(stop := k + window + 1), range(k, k + 1), ends, stop) for k in early]
    for inner, count in _unrolled(record, range(early.stop, starts.stop), back, window):
        low, high = bounds(formula, inner, range(back, back + 1), ends, back + window + 1)
        same = low is high
        low = low.reshape(count, -1)
        pairs.append((low, low if same else high.reshape(count, -1)))
    low = record.ops.cat([pair[0] for pair in pairs])
    if all(pair[0] is pair[1] for pair in pairs):
        return low, low
    return low, record.ops.cat([pair[1] for pair in pairs])


def _unrolled(record: Record, starts: range, back: int, window: int) -> Iterator[tuple[Record, int]]:
    """Cut the trace into overlapping excerpts, one per instant in `starts`, and yield them in groups.

    The excerpt of instant k contains the samples from k - `back` to k + `window`; it is shorter at the end of
    the trace. A group is yielded as (record, number of instants). The record contains the excerpts of these
    instants as one batch.
    """
    length = back + window + 1
    whole = max(min(starts.stop, record.samples - window), starts.start)
    batch = next(iter(record.env.values())).shape[1]
    step = max(_CHUNK // (length * batch), 1)
    for begin in range(starts.start, whole, step):
        chosen = np.arange(begin, min(begin + step, whole))
        rows = np.arange(-back, window + 1)[:, None] + chosen
        env = {name: x[rows].reshape(length, len(chosen) * batch) for name, x in record.env.items()}
        yield replace(record, env=env), len(chosen)
    for k in range(whole, starts.stop):
        yield replace(record, env={name: x[k - back :] for name, x in record.env.items()}), 1


# --------------------------------------------------------------------------- missing signals


def assume_missing_true(formula: ir.Formula, names: Collection[str]) -> ir.Formula:
    """Return the formula with every predicate that reads a missing signal assumed true.

    Signals not in `names` are missing. The value of the result is an upper bound on the formula. A `freeze`
    may store a missing signal under a name; this name then also counts as missing.
    """
    match formula:
        case ir.Predicate(num=num):
            return formula if _read(num) <= set(names) else ir.Truth(True)
        case ir.Freeze(bindings=bindings, body=body):
            known = tuple(each for each in bindings if _read(each[1]) <= set(names))
            inner = assume_missing_true(body, {*names, *(name for name, _ in known)})
            return replace(formula, bindings=known, body=inner) if known else inner
        case _:
            return map_children(formula, formulas=lambda part: assume_missing_true(part, names))


def _read(num: ir.Num) -> set[str]:
    """Names of the signals that an expression reads, and of the values stored by `freeze` that it reads."""
    return {*columns_of(num), *(part.name for part in subexpressions(num) if isinstance(part, ir.FrozenVar))}


# ------------------------------------------------------------------ strict predicates


def by_truth(formula: ir.Formula) -> ir.Formula:
    """Return the formula with truth values, +inf (true) or -inf (false), in place of predicate margins.

    `a > b` is true if its margin a - b is above 0, `a >= b` if it is at least 0. There is no tolerance.
    """
    if isinstance(formula, ir.Predicate):
        return replace(formula, guard=True)
    return map_children(formula, formulas=by_truth)
