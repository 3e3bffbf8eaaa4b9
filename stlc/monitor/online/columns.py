"""Columns that grow sample by sample, in memory bounded by the windows of a formula.

Every column is stored twice, as the least and as the greatest value over all continuations; where nothing is
unknown the two agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias, assert_never

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import execute
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.steps import ArrayPlan, array_plan
from stlc.compile.backends.array.windows import Windows
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns as names_of_columns
from stlc.compile.schedule.schedule import TraceDomain, spanning
from stlc.compile.semantics.semantics import Exact
from stlc.monitor.holes import holes_in, unsure, without_holes
from stlc.monitor.online.streams import (
    ColumnPlan,
    PredicateColumn,
    RecursiveColumn,
    RecursiveOp,
    column,
    read_by,
)
from stlc.monitor.prefix_bounds import reads_seen, with_seen
from stlc.monitor.values import by_truth

Floats: TypeAlias = NDArray[np.float64]
End: TypeAlias = Literal["lower", "upper", "truncate"]
ColumnPlans: TypeAlias = Mapping[End, ColumnPlan]
"""Least and greatest value wherever the trace ends, and the value of the requirement as written."""
Beyond: TypeAlias = Literal["lower", "upper", "truncate", "both"]

NOTHING = ""
"""Placeholder column for formulas that read no column."""

FAR = 1 << 40
"""More samples than any trace has."""

_REMEMBERED = 256
_EXACT = Windows(Exact(), NUMPY)


class ColumnReader:
    """Repeated evaluator of the same formulas; the schedule of each extent is cached.

    Args:
        formulas: over columns.
        end: treatment of rows beyond the last one.
        going_on: the trace does not end with the last row.
        back: lookback in rows.
    """

    def __init__(
        self, formulas: Sequence[ir.Formula], end: Beyond, *, going_on: bool = False, back: int = 0
    ) -> None:
        self.formulas = tuple(formulas)
        self.end = end
        self.back = back
        self._unsure: dict[tuple[frozenset[str], bool], ColumnReader] = {}
        self._stop = FAR if going_on else None
        self.names = frozenset().union(*map(names_of_columns, self.formulas))
        self._known: dict[tuple[int, int, int], ArrayPlan] = {}

    def __call__(self, env: Mapping[str, Floats], start: int, count: int) -> list[Floats]:
        """Values (count, traces) from row `start` on; rows beyond the shortest column are ignored."""
        names = self.names or (NOTHING if NOTHING in env else next(iter(env)),)
        length = min(len(env[name]) for name in names)
        if count <= 0:
            return [next(iter(env.values()))[:0]] * len(self.formulas)
        key = (length, start, count)
        if key not in self._known:
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[key] = array_plan(
                self.formulas, spanning(start, count), TraceDomain(length, self.end, self._stop)
            )
        inner = {name: env[name] if len(env[name]) == length else env[name][:length] for name in names}
        return execute(self._known[key], inner, _EXACT)

    def of_signals(
        self, env: Mapping[str, Floats], start: int, count: int, *, least: bool | None = None
    ) -> list[Floats]:
        """Values of columns in which NaN is an unknown value, taken at its least or at its greatest.

        Where `least` is None the columns (rows, 1) give both, (count, 2).
        """
        rows = {name: env[name] for name in self.names}
        near = {name: values[max(start - self.back, 0) :] for name, values in rows.items()}
        holes = holes_in(near)
        if not holes:
            return self(env, start, count)
        known = {**env, **without_holes(rows, holes)}
        if least is not None:
            return self._sides(holes, least=least)(known, start, count)
        both = (self._sides(holes, least=end)(known, start, count) for end in (True, False))
        return [np.concatenate(pair, axis=1) for pair in zip(*both, strict=True)]

    def _sides(self, holes: frozenset[str], *, least: bool) -> ColumnReader:
        """The reader of the formulas at their least or greatest value."""
        key = (holes, least)
        if key not in self._unsure:
            formulas = [unsure(formula, holes, least=least) for formula in self.formulas]
            self._unsure[key] = ColumnReader(formulas, self.end, going_on=self._stop is not None)
        return self._unsure[key]


@dataclass(slots=True)
class Side:
    """The columns of a plan, at their least or greatest values.

    Attributes:
        plan: the columns to compute.
        end: which bound: least, greatest, or with windows cut at the last sample.
        beyond: rows after the last sample that the formula over the columns reads.
        truth: predicates are true or false, +inf or -inf.
        least: unknown values of a signal are taken at their least, else at their greatest.
        base: number of the first stored sample.
        rows: column -> values from `base` on, (stored + beyond, traces).
    """

    plan: ColumnPlan
    end: End
    beyond: int
    truth: bool = False
    least: bool = True
    base: int = 0
    rows: dict[str, Floats] = field(default_factory=dict)
    _over: bool = False
    _told: bool = False
    _seen: tuple[Mapping[str, Floats], int, int] | None = None
    _settled: dict[str, int] = field(default_factory=dict)
    _pads: dict[str, int] = field(default_factory=dict)
    _leaves: list[tuple[list[PredicateColumn], ColumnReader]] = field(default_factory=list)
    _latched: list[tuple[RecursiveColumn, ColumnReader]] = field(default_factory=list)

    def __post_init__(self) -> None:
        leaves = [stream for stream in self.plan.streams if isinstance(stream, PredicateColumn)]
        self._told = any(reads_seen(leaf.formula) for leaf in leaves)
        for reads in dict.fromkeys((leaf.back, leaf.ahead) for leaf in leaves):
            alike = [leaf for leaf in leaves if (leaf.back, leaf.ahead) == reads]
            formulas = [by_truth(leaf.formula) if self.truth else leaf.formula for leaf in alike]
            going_on = self.end != "truncate" and not self._over
            self._leaves.append((alike, ColumnReader(formulas, self.end, going_on=going_on, back=reads[0])))
        latched = [stream for stream in self.plan.streams if isinstance(stream, RecursiveColumn)]
        self._latched = [(stream, ColumnReader(stream.parts, self.end)) for stream in latched]
        if self.end == "truncate":
            self._pads = dict.fromkeys((stream.name for stream in self.plan.streams), 0)
            return
        self._pads = dict.fromkeys((stream.name for stream in self.plan.streams), self.beyond)
        for stream in reversed(self.plan.streams):
            wanted = self._pads[stream.name] + stream.ahead
            for name in read_by(stream):
                self._pads[name] = max(self._pads[name], wanted)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take in new samples.

        Args:
            signals: columns (stored, traces) that end with the last sample.
            first: number of their first row.
            samples: total number of samples.
        """
        self._seen = (signals, first, samples)
        signals = with_seen(signals) if self._told else signals
        traces = next(iter(signals.values())).shape[1]
        self.rows[NOTHING] = np.zeros((samples + self.beyond - self.base, traces))
        for leaves, reader in self._leaves:
            self._grow_leaves(leaves, reader, signals, first, samples)
        for stream, reader in self._latched:
            self._grow_latched(stream, reader, samples)

    def over(self) -> Side:
        """The columns with the last sample as the end of the trace: windows beyond it are clipped."""
        if self._seen is None or all(stream.ahead == 0 for stream in self.plan.streams):
            return self
        last = replace(
            self, rows=dict(self.rows), _settled=dict(self._settled), _leaves=[], _latched=[], _over=True
        )
        last.grow(*self._seen)
        return last

    def values(self, reader: ColumnReader, start: int, count: int) -> list[Floats]:
        """Values (count, traces) of formulas over the columns, from sample `start` on."""
        return reader(self.rows, start - self.base, count)

    def drop(self, first: int) -> None:
        """Forget rows before sample `first` that no column needs."""
        needs = [self._settled[stream.name] - max(stream.back, 1) for stream, _ in self._latched]
        base = max(min([first, *needs]), self.base)
        if base > self.base:
            self.rows = {name: values[base - self.base :] for name, values in self.rows.items()}
            self.base = base

    def _grow_leaves(
        self,
        leaves: Sequence[PredicateColumn],
        reader: ColumnReader,
        env: Mapping[str, Floats],
        first: int,
        samples: int,
    ) -> None:
        start, ahead = self._settled.get(leaves[0].name, 0), leaves[0].ahead
        count = samples + max(self._pads[leaf.name] for leaf in leaves) - start
        found = reader.of_signals(env, start - first, count, least=self.least)
        for leaf, values in zip(leaves, found, strict=True):
            self._put(leaf.name, start, values[: samples + self._pads[leaf.name] - start])
            self._settled[leaf.name] = max(samples - ahead, start)

    def _grow_latched(self, stream: RecursiveColumn, reader: ColumnReader, samples: int) -> None:
        start = self._settled.get(stream.name, 0)
        count = samples + self._pads[stream.name] - start
        parts = self.values(reader, start, count)
        last = self.rows[stream.name][start - 1 - self.base] if start else None
        self._put(stream.name, start, continued(stream.op, parts, last))
        lags = [samples - self._settled[name] for name in read_by(stream)]
        self._settled[stream.name] = max(samples - max(lags, default=0) - stream.ahead, start)

    def _put(self, name: str, start: int, values: Floats) -> None:
        """Replace all rows from sample `start` on."""
        kept = self.rows.get(name)
        self.rows[name] = values if kept is None else np.concatenate([kept[: start - self.base], values])


def continued(op: RecursiveOp, parts: Sequence[Floats], last: Floats | None) -> Floats:
    """The values of a past operator, given its operands and the value before them."""
    match op:
        case "once":
            found = np.maximum.accumulate(parts[0], axis=0)
            return found if last is None else np.maximum(found, last)
        case "historically":
            found = np.minimum.accumulate(parts[0], axis=0)
            return found if last is None else np.minimum(found, last)
        case "since":
            return _since(parts[0], parts[1], last)
        case "trigger":
            return -_since(-parts[0], -parts[1], None if last is None else -last)
    assert_never(op)


_SINCE = ColumnReader([ir.Since("since", ir.Window(0, None), column("left"), column("right"))], "truncate")


def _since(left: Floats, right: Floats, last: Floats | None) -> Floats:
    """`s(k) = min(left(k), max(right(k), s(k - 1)))`."""
    (found,) = _SINCE({"left": left, "right": right}, 0, len(left))
    if last is None:
        return np.asarray(found)
    return np.maximum(found, np.minimum(np.minimum.accumulate(left, axis=0), last))
