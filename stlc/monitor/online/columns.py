"""Time series of robustness values, to which one row is added per sample.

Such a time series is called a column. Only the rows that a formula still needs are stored. For each row there
are two values: the least and the greatest robustness over all continuations of the trace. They are equal if
no later sample can change the robustness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias, assert_never

import numpy as np

from stlc.compile.backends.array.graph import execute
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.steps import ArrayPlan, array_plan
from stlc.compile.backends.array.windows import Windows
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns as names_of_columns
from stlc.compile.schedule.schedule import TraceDomain, spanning
from stlc.compile.semantics.semantics import Exact
from stlc.monitor.holes import holes_in, partial, unsure, without_holes
from stlc.monitor.online.history import ColumnHistory, Floats
from stlc.monitor.online.streams import (
    ColumnPlan,
    DerivedColumn,
    PredicateColumn,
    RecursiveColumn,
    RecursiveOp,
    column,
    read_by,
)
from stlc.monitor.prefix_bounds import FAR, SEEN, with_seen
from stlc.monitor.values import by_truth

End: TypeAlias = Literal["lower", "upper", "truncate"]
ColumnPlans: TypeAlias = Mapping[End, ColumnPlan]
"""Least and greatest value wherever the trace ends, and the value of the requirement as written."""
Beyond: TypeAlias = Literal["lower", "upper", "truncate", "both"]

NOTHING = ""
"""Placeholder column for formulas that read no column."""

_REMEMBERED = 256
_EXACT = Windows(Exact(), NUMPY)


class ColumnReader:
    """Evaluator of fixed formulas over growing columns (time series, one row per sample).

    The order of computation is cached for every range of rows.

    Args:
        formulas: formulas to evaluate; each of their predicates stands for a column.
        end: value of a column after its last row: -inf if "lower", +inf if "upper". If "both", a column has
            two parts side by side, one for each of these cases. If "truncate", windows are clipped at the
            last row.
        going_on: whether the trace continues after the last row.
        back: lookback of the formulas: number of rows that they read before the first requested row. Unknown
            values (NaN) in still earlier rows have no effect.
    """

    def __init__(
        self, formulas: Sequence[ir.Formula], end: Beyond, *, going_on: bool = False, back: int = 0
    ) -> None:
        self.formulas = tuple(formulas)
        self.end = end
        self.back = back
        self._partial = any(map(partial, self.formulas))
        self._unsure: dict[tuple[frozenset[str], bool | None], ColumnReader] = {}
        self._stop = FAR if going_on else None
        self.names = frozenset().union(*map(names_of_columns, self.formulas))
        self._known: dict[tuple[int, int, int], ArrayPlan] = {}

    def __call__(self, env: Mapping[str, Floats], start: int, count: int) -> list[Floats]:
        """Return the values (count, traces) of each formula at `count` rows, the first of which is `start`.

        All columns in `env`, (rows, traces), must have the same number of rows.
        """
        names = self.names or (NOTHING if NOTHING in env else next(iter(env)),)
        length = len(env[next(iter(names))])
        if count <= 0:
            return [next(iter(env.values()))[:0]] * len(self.formulas)
        key = (length, start, count)
        if key not in self._known:
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[key] = array_plan(
                self.formulas, spanning(start, count), TraceDomain(length, self.end, self._stop)
            )
        return execute(self._known[key], {name: env[name] for name in names}, _EXACT)

    def of_signals(
        self, env: Mapping[str, Floats], start: int, count: int, *, least: bool | None = None
    ) -> list[Floats]:
        """Return bounds on each formula at `count` rows, the first of which is `start`.

        The bounds hold for all values that the unknown entries (NaN) of the columns may have, and functions
        outside of their domains. `least` selects the lower (True) or the upper (False) bound, (count,
        traces). If `least` is None, the columns have one trace, and both bounds are returned side by side,
        (count, 2).
        """
        rows = {name: env[name] for name in self.names}
        near = {name: values[max(start - self.back, 0) :] for name, values in rows.items()}
        holes = holes_in(near)
        if not holes and not self._partial:
            return self(env, start, count)
        found = self._sides(holes, least)({**env, **without_holes(rows, holes)}, start, count)
        if least is not None:
            return found
        both = found[: len(self.formulas)], found[len(self.formulas) :]
        return [np.concatenate(pair, axis=1) for pair in zip(*both, strict=True)]

    def _sides(self, holes: frozenset[str], least: bool | None) -> ColumnReader:
        """Return an evaluator of bounds on all formulas: of lower bounds if `least`, else of upper bounds.

        If `least` is None, it evaluates all lower bounds, and then all upper bounds. The columns named in
        `holes` contain unknown values.
        """
        key = (holes, least)
        if key not in self._unsure:
            sides = (True, False) if least is None else (least,)
            formulas = [unsure(formula, holes, least=side) for side in sides for formula in self.formulas]
            self._unsure[key] = ColumnReader(formulas, self.end, going_on=self._stop is not None)
        return self._unsure[key]


@dataclass(slots=True)
class Side:
    """Columns of one formula, from which bounds on its robustness are computed.

    The columns are the time series of the predicates and past operators of the formula.

    Attributes:
        plan: the columns to compute.
        end: value of a predicate after the last sample: -inf if "lower", +inf if "upper". If "both", the two
            values are stored side by side, (rows, 2). If "truncate", windows are clipped at the last sample.
        beyond: number of instants after the last sample at which the formula reads its columns.
        truth: whether the value of a predicate is its truth value, +inf or -inf, instead of its margin.
        least: bound that is computed for a predicate that reads unknown samples (NaN). True: the lower bound;
            False: the upper bound; None: both.
        rows: column name -> view of its stored rows, the first of which is sample `base`.
        history: storage of the rows.
    """

    plan: ColumnPlan
    end: Beyond
    beyond: int
    truth: bool = False
    least: bool | None = True
    rows: dict[str, Floats] = field(default_factory=dict, init=False)
    history: ColumnHistory = field(init=False)
    _over: bool = False
    _last: tuple[Mapping[str, Floats], int, int] | None = None
    _settled: dict[str, int] = field(default_factory=dict)
    _predicates: list[tuple[list[PredicateColumn], ColumnReader]] = field(default_factory=list, init=False)
    _recursive: list[tuple[RecursiveColumn, ColumnReader]] = field(default_factory=list, init=False)
    _names: tuple[str, ...] = field(init=False)
    _reads_seen: bool = field(init=False)

    def __post_init__(self) -> None:
        streams = self.plan.streams
        predicates = [stream for stream in streams if isinstance(stream, PredicateColumn)]
        going_on = self.end != "truncate" and not self._over
        for alike in dict.fromkeys((each.back, each.ahead, _of_the_present(each)) for each in predicates):
            group = [e for e in predicates if (e.back, e.ahead, _of_the_present(e)) == alike]
            formulas = [by_truth(each.formula) if self.truth else each.formula for each in group]
            end = "truncate" if alike[2] else self.end
            reader = ColumnReader(formulas, end, going_on=going_on and not alike[2], back=alike[0])
            self._predicates.append((group, reader))
        self._reads_seen = any(SEEN in reader.names for _, reader in self._predicates)
        self._names = (NOTHING, *(stream.name for stream in streams))
        recursive = [stream for stream in streams if isinstance(stream, RecursiveColumn)]
        self._recursive = [(stream, ColumnReader(stream.parts, self.end)) for stream in recursive]
        self.history = ColumnHistory(self._farthest(), _UNKNOWN[self.end])

    def _farthest(self) -> int:
        """Number of instants after the last sample at which the columns must have a value.

        This is how far the formula, or a column computed from other columns, reads ahead. The number is 0 if
        windows are clipped.
        """
        if self.end == "truncate":
            return 0
        pads = dict.fromkeys((stream.name for stream in self.plan.streams), self.beyond)
        for stream in reversed(self.plan.streams):
            for name in read_by(stream):
                pads[name] = max(pads[name], pads[stream.name] + stream.ahead)
        return max(pads.values(), default=self.beyond)

    @property
    def base(self) -> int:
        """Index of the first stored sample."""
        return self.history.first

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Add new samples and compute the columns at these samples.

        Args:
            signals: signal name -> stored samples (stored, traces), up to the newest sample.
            first: index in the trace of the first stored sample.
            samples: number of samples that the trace now has.
        """
        self._last = (signals, first, samples)
        width = 2 if self.end == "both" else next(iter(signals.values())).shape[1]
        self.history.grow(self._names, samples - self.history.samples, width)
        self.rows = self.history.columns()
        signals = with_seen(signals) if self._reads_seen else signals
        for group, reader in self._predicates:
            self._grow_predicates(group, reader, signals, first)
        for stream, reader in self._recursive:
            self._grow_recursive(stream, reader)

    def _grow_predicates(
        self, group: Sequence[PredicateColumn], reader: ColumnReader, env: Mapping[str, Floats], first: int
    ) -> None:
        samples, start = self.history.samples, self._settled.get(group[0].name, 0)
        stop = samples if _of_the_present(group[0]) else self.base + len(self.rows[NOTHING])
        found = reader.of_signals(env, start - first, stop - start, least=self.least)
        for stream, values in zip(group, found, strict=True):
            self.history.put(stream.name, start, values)
            self._settled[stream.name] = max(samples - stream.ahead, start)

    def _grow_recursive(self, stream: RecursiveColumn, reader: ColumnReader) -> None:
        samples, start = self.history.samples, self._settled.get(stream.name, 0)
        parts = self.values(reader, start, self.base + len(self.rows[NOTHING]) - start)
        last = self.rows[stream.name][start - 1 - self.base] if start else None
        self.history.put(stream.name, start, continued(stream.op, parts, last))
        lags = [samples - self._settled[name] for name in reader.names]
        self._settled[stream.name] = max(samples - max(lags, default=0) - stream.ahead, start)

    def over(self) -> Side:
        """Return a copy for a trace that ends with the last sample, so that windows are clipped there.

        If no column reads later samples, the end makes no difference, and `self` is returned.
        """
        if self._last is None or all(stream.ahead == 0 for stream in self.plan.streams):
            return self
        last = replace(self, _settled=dict(self._settled), _over=True)
        last.history = deepcopy(self.history)
        last.grow(*self._last)
        return last

    def values(self, reader: ColumnReader, start: int, count: int) -> list[Floats]:
        """Return the values (count, traces) of the formulas in `reader` at `count` samples.

        The first of these samples is `start`.
        """
        return reader(self.rows, start - self.base, count)

    def drop(self, first: int) -> None:
        """Free the rows before sample `first`, except rows that an unbounded past operator still needs."""
        needs = [self._settled[stream.name] - max(stream.back, 1) for stream, _ in self._recursive]
        if (base := min([first, *needs])) > self.base:
            self.history.forget(base)
            self.rows = self.history.columns()


_UNKNOWN: Mapping[Beyond, float | tuple[float, float]] = {
    "lower": -math.inf,
    "upper": math.inf,
    "both": (-math.inf, math.inf),
    "truncate": 0.0,
}
"""Value of a predicate after the last sample."""


def _of_the_present(stream: DerivedColumn) -> bool:
    """True for a predicate that reads signals only at the sample at which it is evaluated."""
    return isinstance(stream, PredicateColumn) and not (
        stream.back or stream.ahead or isinstance(stream.formula, ir.Freeze)
    )


def shareable(plans: ColumnPlans) -> bool:
    """True if one formula gives the lower and the upper bound, so that both are computed together.

    `plans` contains a formula for each bound. The result is True if three conditions hold. The formulas are
    equal. Every predicate reads the signals only at the sample at which it is evaluated. No operand of an
    unbounded past operator reads later samples.
    """
    planned = plans["truncate"]
    return plans["lower"] == plans["upper"] == planned and all(
        _of_the_present(stream) or (isinstance(stream, RecursiveColumn) and not stream.ahead)
        for stream in planned.streams
    )


def continued(op: RecursiveOp, parts: Sequence[Floats], last: Floats | None) -> Floats:
    """Return the values (rows, traces) of an unbounded past operator, computed recursively.

    Args:
        op: the operator.
        parts: values of its operands at the rows to compute, (rows, traces) each.
        last: value of the operator in the row before these rows, (traces,); None if there is no such row.
    """
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
    """Return the values s of an unbounded `since`: `s(k) = min(left(k), max(right(k), s(k - 1)))`.

    `last` contains the values in the row before the first one, (traces,), or is None.
    """
    (found,) = _SINCE({"left": left, "right": right}, 0, len(left))
    if last is None:
        return np.asarray(found)
    return np.maximum(found, np.minimum(np.minimum.accumulate(left, axis=0), last))
