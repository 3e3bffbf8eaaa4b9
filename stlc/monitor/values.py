"""Robustness of a formula on a trace, at the instants at which a requirement is evaluated."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal, TypeAlias, cast

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.schedule import Boundary
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.defined import defined_at
from stlc.compile.ir.holes import holes_in, partial, unsure, without_holes
from stlc.compile.namespace import Array, Ops
from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.semantics import Exact, Semantics
from stlc.monitor.cells import Cells
from stlc.signature import Signature

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
        holes: names of the signals with unknown values (`stlc.compile.ir.holes`).
        computed: whether NaN that a function gives outside of its domain is unknown too.
        infinite: whether signals contain infinities, of which any function may give NaN.
        cells: recorded values between the samples, if the signals were resampled.
        loose: whether a step of the grid counts as a whole: windows end at an instant of their own.
    """

    env: Mapping[str, Array]
    ops: Ops
    semantics: Semantics = Exact()  # noqa: RUF009 - frozen
    holes: frozenset[str] = frozenset()
    computed: bool = False
    infinite: bool = False
    cells: Cells | None = None
    loose: bool = False

    @staticmethod
    def of(
        env: Mapping[str, Array],
        ops: Ops = NUMPY,
        cells: Cells | None = None,
        semantics: Semantics | None = None,
    ) -> Record:
        """Return a record of the signals `env`; in NumPy arrays, NaN is an unknown value."""
        semantics = semantics or Exact()
        if ops is not NUMPY:
            return Record(env, ops, semantics, cells=cells)
        holes, infinite = holes_in(env), any(np.isinf(values).any() for values in env.values())
        filled = without_holes(env, holes) if holes else env
        return Record(filled, ops, semantics, holes, computed=True, infinite=infinite, cells=cells)

    @property
    def sure(self) -> Record:
        """Copy without unknown values, for formulas that account for them themselves (`sides`)."""
        return replace(self, holes=frozenset(), computed=False, infinite=False, cells=None)

    def of_cells(self, formula: ir.Formula, *, loose: bool) -> Record:
        """Copy in which every recorded sample counts for `formula`; signals are intervals for a `freeze`."""
        if self.cells is None:
            return self
        if not self.semantics.exact:
            return replace(self, cells=None)
        if any(isinstance(node, ir.Freeze) for node in formula.walk()):
            env, holes = self.cells.interval_env()
            return Record(env, INTERVALS, self.semantics, holes)
        ready = replace(self, env=dict(self.env), loose=loose)
        ready.sides(formula)
        return ready

    def sides(self, formula: ir.Formula) -> tuple[ir.Formula, ir.Formula]:
        """Return two formulas, for a lower and an upper bound on `formula`, to be evaluated on `sure`.

        Both are `formula` itself if no value that it reads can be unknown.
        """
        if self.cells is not None and self.semantics.exact:
            return self.cells.sides(formula, cast("dict[str, Array]", self.env), loose=self.loose)
        if not self.holes and not (self.computed and (self.infinite or partial(formula))):
            return formula, formula
        may = {"computed": self.computed, "infinite": self.infinite}
        least, most = (unsure(formula, self.holes, least=x, **may) for x in (True, False))
        return (formula, formula) if least == most else (least, most)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(next(iter(self.env.values())))

    def cut(self, stop: int) -> Record:
        """Return a record of the first `stop` samples."""
        return self if stop >= self.samples else self.part(0, stop)

    def part(self, first: int, stop: int) -> Record:
        """Return a record of the samples from `first` up to `stop`."""
        return replace(self, env={name: x[first:stop] for name, x in self.env.items()})

    def values(
        self, formulas: Sequence[ir.Formula], instants: range, end: Boundary, stop: int | None = None
    ) -> list[Array]:
        """Values of each formula at `instants`, `(instants, batch)`.

        `end` is the treatment of windows that extend beyond the last sample: "strict" gives NaN, "truncate"
        clips them, "lower" and "upper" give a bound. If the trace continues, `stop` is the number of samples
        in the complete trace, to whose end unbounded windows extend.
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

    If nothing is unknown, the same array is returned twice. `stop` is the number of samples in the complete
    trace, if the record contains fewer.
    """
    least, most = record.sides(formula)
    end: Boundary | None = None
    if ends == "truncate":
        end = "truncate"
    elif stop is None or stop <= record.samples:
        stop = None
        end = "strict" if defined_at(formula, record.samples, starts) else None
    if end is None:
        (low,) = record.values([least], starts, "lower", stop)
        (high,) = record.values([most], starts, "upper", stop)
        return low, high
    if least is most:
        (value,) = record.values([formula], starts, end)
        return value, value
    low, high = record.values([least, most], starts, "truncate")  # of cells, a part of a window may be empty
    return low, high


def window_bounds(
    formula: ir.Formula, record: Record, starts: range, window: int, ends: Ends
) -> tuple[Array, Array]:
    """Least and greatest values of a formula whose `end` moves with the instant, each `(count, batch)`.

    `end` is `window` samples after each instant. Each instant is evaluated on its own excerpt of the trace,
    from the first sample that past operators read to `end`. If the trace is too short for an excerpt, the
    missing samples are unknown; if `ends` is "truncate", the excerpt stops at the last sample instead.
    """
    back = formula.history
    early = range(starts.start, max(min(back, starts.stop), starts.start))
    excerpts = [(record.cut(k + window + 1), k, 1) for k in early]
    later = _unrolled(record, range(early.stop, starts.stop), back, window)
    lows, highs = [], []
    for inner, k, count in chain(excerpts, later):
        low, high = bounds(formula, inner, range(k, k + 1), ends, k + window + 1)
        lows.append(low.reshape(count, -1))
        highs.append(lows[-1] if high is low else high.reshape(count, -1))
    whole = record.ops.cat(lows)
    same = all(low is high for low, high in zip(lows, highs, strict=True))
    return whole, whole if same else record.ops.cat(highs)


def _unrolled(record: Record, starts: range, back: int, window: int) -> Iterator[tuple[Record, int, int]]:
    """Cut the trace into overlapping excerpts, one per instant in `starts`, and yield them in groups.

    The excerpt of instant k goes from k - `back` to k + `window`, or to the end of the trace. A group is a
    record of its excerpts as one batch, `back`, and the number of its instants.
    """
    length = back + window + 1
    whole = max(min(starts.stop, record.samples - window), starts.start)
    batch = next(iter(record.env.values())).shape[1]
    step = max(_CHUNK // (length * batch), 1)
    for begin in range(starts.start, whole, step):
        chosen = np.arange(begin, min(begin + step, whole))
        rows = np.arange(-back, window + 1)[:, None] + chosen
        env = {name: x[rows].reshape(length, len(chosen) * batch) for name, x in record.env.items()}
        yield replace(record, env=env), back, len(chosen)
    for k in range(whole, starts.stop):
        yield replace(record, env={name: x[k - back :] for name, x in record.env.items()}), back, 1


def assume_missing_true(formula: ir.Formula, names: Collection[str]) -> ir.Formula:
    """Return the formula with every predicate that reads a missing signal assumed true.

    Signals not in `names` are missing, and so are names under which a `freeze` stores one. The value of the
    result is an upper bound on the formula.
    """
    match formula:
        case ir.Predicate(num=num):
            return formula if _read(num) <= set(names) else ir.Truth(True)
        case ir.Freeze(bindings=bindings, body=body):
            known = tuple(each for each in bindings if _read(each[1]) <= set(names))
            inner = assume_missing_true(body, {*names, *(name for name, _ in known)})
            return replace(formula, bindings=known, body=inner) if known else inner
        case _:
            return formula.map_children(formulas=lambda part: assume_missing_true(part, names))


def _read(num: ir.Num) -> set[str]:
    """Names of the signals that an expression reads, and of the values stored by `freeze` that it reads."""
    return {*num.columns, *num.frozen}


def decisive(rule: CompiledRequirement, tolerance: float, signature: Signature) -> CompiledRequirement:
    """Return the requirement whose robustness decides the verdict with a tolerance; mostly `rule` itself.

    With the tolerance 0, the robustness of every predicate is +inf or -inf, by its truth: then `<` and `<=`
    differ. A truth value or a member of an enum has the margin 1/2. With a tolerance of at least that, the
    predicates on these alone are +inf or -inf, since what is false is never nearly true.

    Args:
        rule: the requirement.
        tolerance: a requirement is satisfied if its robustness is at least minus this value.
        signature: the signals of the specification.
    """
    if 0.0 < tolerance < 0.5:
        return rule
    discrete = {column.name for column in signature.columns if column.kind in ("bool", "enum")}
    formula = by_truth(rule.formula, discrete if tolerance else None)
    return rule if formula == rule.formula else replace(rule, formula=formula)


def by_truth(formula: ir.Formula, signals: Collection[str] | None = None) -> ir.Formula:
    """Return the formula with +inf for true and -inf for false predicates; `a >= b` is true at margin 0.

    `signals`: only the predicates that read nothing else than these; None: all predicates.
    """
    if isinstance(formula, ir.Predicate):
        exact = signals is None or _read(formula.num) <= set(signals)
        return replace(formula, guard=True) if exact else formula
    return formula.map_children(formulas=lambda part: by_truth(part, signals))
