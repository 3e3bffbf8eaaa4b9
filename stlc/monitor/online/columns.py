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
from typing import Literal, TypeAlias

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
from stlc.monitor.online.streams import ColumnPlan, DerivedColumn, RecursiveOp, column
from stlc.monitor.prefix_bounds import FAR, SEEN, with_seen

Beyond: TypeAlias = Literal["lower", "upper", "truncate", "both"]
ColumnPlans: TypeAlias = Mapping[Beyond, ColumnPlan]
"""Least and greatest value wherever the trace ends, and the value of the requirement as written."""

NOTHING = ""
"""Placeholder column for formulas that read no column."""

_UNKNOWN: Mapping[Beyond, float | tuple[float, float]] = {
    "lower": -math.inf,
    "upper": math.inf,
    "both": (-math.inf, math.inf),
    "truncate": 0.0,
}
"""Value of a predicate after the last sample."""

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
        holes = holes_in({name: values[max(start - self.back, 0) :] for name, values in rows.items()})
        if not holes and not self._partial:
            return self(env, start, count)
        if (holes, least) not in self._unsure:
            sides = (True, False) if least is None else (least,)
            formulas = [unsure(formula, holes, least=side) for side in sides for formula in self.formulas]
            self._unsure[holes, least] = ColumnReader(formulas, self.end, going_on=self._stop is not None)
        found = self._unsure[holes, least]({**env, **without_holes(rows, holes)}, start, count)
        if least is not None:
            return found
        both = found[: len(self.formulas)], found[len(self.formulas) :]
        return [np.concatenate(pair, axis=1) for pair in zip(*both, strict=True)]


@dataclass(slots=True)
class Side:
    """Columns of one formula, from which bounds on its robustness are computed.

    The columns are the time series of the predicates and past operators of the formula.

    Attributes:
        plan: the columns to compute.
        end: value of a predicate after the last sample, as in `ColumnReader`; if "both", rows have two parts.
        beyond: number of instants after the last sample at which the formula reads its columns.
        least: bound that is computed for a predicate that reads unknown samples (NaN). True: the lower bound;
            False: the upper bound; None: both.
        rows: column name -> view of its stored rows, the first of which is sample `history.first`.
        history: storage of the rows.
    """

    plan: ColumnPlan
    end: Beyond
    beyond: int
    least: bool | None = True
    rows: dict[str, Floats] = field(default_factory=dict, init=False)
    history: ColumnHistory = field(init=False)
    _over: bool = False
    _last: tuple[Mapping[str, Floats], int, int] | None = None
    _settled: dict[str, int] = field(default_factory=dict)
    _names: tuple[str, ...] = field(init=False)
    _predicates: list[tuple[list[DerivedColumn], ColumnReader]] = field(default_factory=list, init=False)
    _recursive: list[tuple[DerivedColumn, ColumnReader]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self._names = (NOTHING, *(stream.name for stream in self.plan.streams))
        pads = dict.fromkeys(self._names, self.beyond)  # rows that others read after the last sample
        for stream in reversed(self.plan.streams):
            for name in stream.reads:
                pads[name] = max(pads[name], pads[stream.name] + stream.ahead)
        beyond = 0 if self.end == "truncate" else max(pads.values())
        self.history = ColumnHistory(beyond, _UNKNOWN[self.end])
        groups: dict[tuple[int, int, bool], list[DerivedColumn]] = {}
        for stream in self.plan.streams:
            if stream.op is None:
                groups.setdefault((stream.back, stream.ahead, stream.pointwise), []).append(stream)
            else:
                self._recursive.append((stream, ColumnReader(stream.parts, self.end)))
        for (back, _, pointwise), group in groups.items():
            formulas = [each.parts[0] for each in group]
            end: Beyond = "truncate" if pointwise else self.end
            going_on = end != "truncate" and not self._over
            self._predicates.append((group, ColumnReader(formulas, end, going_on=going_on, back=back)))

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Add samples as in `Tracker.grow`, and compute the columns at these."""
        self._last = (signals, first, samples)
        width = 2 if self.end == "both" else next(iter(signals.values())).shape[1]
        self.history.grow(self._names, samples - self.history.samples, width)
        self.rows = self.history.columns()
        stop = self.history.first + len(self.rows[NOTHING])
        if any(SEEN in reader.names for _, reader in self._predicates):
            signals = with_seen(signals)
        for group, reader in self._predicates:
            start, end = self._settled.get(group[0].name, 0), samples if group[0].pointwise else stop
            found = reader.of_signals(signals, start - first, end - start, least=self.least)
            for stream, values in zip(group, found, strict=True):
                self.history.put(stream.name, start, values)
                self._settled[stream.name] = max(samples - stream.ahead, start)
        for stream, reader in self._recursive:
            assert stream.op is not None
            start = self._settled.get(stream.name, 0)
            parts = self.values(reader, start, stop - start)
            last = self.rows[stream.name][start - 1 - self.history.first] if start else None
            self.history.put(stream.name, start, continued(stream.op, parts, last))
            settled = min((self._settled[name] for name in reader.names), default=samples)
            self._settled[stream.name] = max(settled - stream.ahead, start)

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
        """Return the values (count, traces) of the formulas in `reader` at `count` samples from `start`."""
        return reader(self.rows, start - self.history.first, count)

    def drop(self, first: int) -> None:
        """Free the rows before sample `first`, except rows that an unbounded past operator still needs."""
        needs = [self._settled[stream.name] - max(stream.back, 1) for stream, _ in self._recursive]
        if (base := min([first, *needs])) > self.history.first:
            self.history.forget(base)
            self.rows = self.history.columns()


def shareable(plans: ColumnPlans) -> bool:
    """True if one formula gives the lower and the upper bound, so that both are computed together.

    The formulas for both bounds are then equal, every predicate reads the signals only at the sample at which
    it is evaluated, and no operand of an unbounded past operator reads later samples.
    """
    planned = plans["truncate"]
    return plans["lower"] == plans["upper"] == planned and all(
        not stream.ahead if stream.op else stream.pointwise for stream in planned.streams
    )


_SINCE = ColumnReader([ir.Since("since", ir.Window(0, None), column("left"), column("right"))], "truncate")


def continued(op: RecursiveOp, parts: Sequence[Floats], last: Floats | None) -> Floats:
    """Return the values (rows, traces) of an unbounded past operator, computed recursively.

    `parts` are the values of its operands at these rows, (rows, traces) each. `last` is the value of the
    operator in the row before them, (traces,); None if there is no such row.
    """
    if op == "trigger":
        return -continued("since", [-part for part in parts], None if last is None else -last)
    if op == "since":
        (found,) = _SINCE({"left": parts[0], "right": parts[1]}, 0, len(parts[0]))
        later = None if last is None else np.minimum(np.minimum.accumulate(parts[0], axis=0), last)
        return found if later is None else np.maximum(found, later)
    extreme = np.maximum if op == "once" else np.minimum
    found = extreme.accumulate(parts[0], axis=0)
    return found if last is None else extreme(found, last)
