"""Signals that are known up to an error: every sample is an interval, and robustness has bounds.

The bounds hold for all errors of all samples within their limits, each independent of the others. The
evaluators run over the array library of intervals (`stlc.compile.backends.array.interval_ops`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from stlc.compile.backends.array.interval import EPSILON, Floats, Intervals, magnitudes, mul, widened
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.namespace import Array
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.grammar.spec import Spec
from stlc.jsontext import Num
from stlc.monitor.values import Record
from stlc.signature import Column
from stlc.units import Unit

_AMOUNT = re.compile(r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>.*)")
_INDEX = re.compile(r"(?<=.)\[\d+\]\Z")


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Greatest error of each sample of a signal.

    Attributes:
        absolute: error in `unit`, 0 or more.
        relative: error as a share of the magnitude of the sample, 0 or more.
        unit: unit of `absolute`; without text it is that of the signal.
    """

    JSON: ClassVar = "absolute relative unit=unit.text"

    absolute: Num = 0.0
    relative: Num = 0.0
    unit: Unit = Unit.ONE

    @staticmethod
    def parse(text: str) -> Uncertainty:
        """Return the uncertainty that a text such as `0.1m`, `0.1` or `2%` states.

        Raises ValueError, which says what is expected, if the text is no amount or its unit is unknown.
        """
        match = _AMOUNT.fullmatch(text.strip())
        if match is None or not math.isfinite(float(match["number"])):
            raise ValueError(
                f"`{text}` is not an amount with its unit, or a percentage of the value: 0.1m, 2%"
            )
        number, unit = float(match["number"]), match["unit"].strip()
        if unit == "%":
            return Uncertainty(relative=number / 100.0)
        return Uncertainty(absolute=number, unit=Unit.parse(unit) if unit else Unit.ONE)

    def __str__(self) -> str:
        if self.relative and not self.absolute:
            return f"{100.0 * self.relative:.6g} %"
        return f"{self.absolute:.6g} {self.unit.text}".rstrip()


Uncertainties = Mapping[str, Uncertainty]
"""Signal, or vector for all of its components -> its uncertainty."""


def uncertain_record(
    record: Record, uncertain: Uncertainties, compiled: Compiled, rules: Sequence[CompiledRequirement]
) -> Record:
    """Return the record in which each sample of the signals in `uncertain` is an interval.

    Raises:
        UsageError: U101, an unknown signal, a unit that measures something else, or a signal without order;
            a requirement calls a Python function, whose values have no bounds.
    """
    columns = {column.name: column for column in compiled.signature.columns}
    findings = [found for name, x in uncertain.items() if (found := _misfit(name, x, columns, compiled.spec))]
    findings += _opaque(rules)
    if findings:
        raise UsageError(*findings)
    given, holes = record.env, record.holes
    if record.cells is not None:
        given, holes = record.cells.interval_env()
    env: dict[str, Array] = {}
    for name, values in given.items():
        known = uncertain.get(name, uncertain.get(_INDEX.sub("", name)))
        centre = values if isinstance(values, Intervals) else Intervals.point(values)
        if known is not None:
            factor = float(known.unit.ratio / columns[name].unit.ratio) if known.unit.text else 1.0
            share, amount = known.relative * (1.0 + EPSILON), known.absolute * factor * (1.0 + 2.0 * EPSILON)
            if share or amount:  # rounded outward
                error = (mul(magnitudes(centre), share) + amount).high if share else amount
                centre = widened(centre.low - error, centre.high + error)
        env[name] = centre
    return replace(record, env=env, ops=INTERVALS, computed=False, holes=holes, cells=None)


def outer(low: Array, high: Array) -> tuple[Floats, Floats]:
    """Lower end of a lower bound and upper end of an upper bound; numbers are returned unchanged."""
    return (low.low, high.high) if isinstance(low, Intervals) else (low, high)


def outer_of(values: Array, end: str) -> Array:
    """Numbers for intervals: the end that is asked for, or NaN where both differ; numbers are unchanged."""
    if not isinstance(values, Intervals):
        return values
    low, high = values.low, values.high
    return low if end == "lower" else high if end == "upper" else np.where(low == high, low, math.nan)


def _misfit(
    name: str, uncertain: Uncertainty, columns: Mapping[str, Column], spec: Spec
) -> Diagnostic | None:
    """Return the reason for which a signal cannot have this uncertainty; None if it can."""
    vectors = {_INDEX.sub("", key): column for key, column in columns.items()}
    known = columns.get(name) or vectors.get(name)
    if known is None:
        note = (f"signals: {', '.join(columns)}",)
        missing = Diagnostic("U101", f"`--uncertain {name}=…`: no signal `{name}`", note=note)
        return missing.near(name, {**columns, **vectors})
    signals = spec.read
    span = next((item.name_span for item in signals if item.name == _INDEX.sub("", name)), None)
    label = "declared here" if span else ""
    if known.kind in ("bool", "enum"):
        message = f"`--uncertain {name}=…`: a signal of type {known.kind} has no error"
        return Diagnostic("U101", message, span, label=label)
    unit = uncertain.unit
    if not unit.text or not known.unit.text or unit.same_dims(known.unit.interval):
        return None
    message = f"`--uncertain {name}={uncertain}`: `{name}` is in [{known.unit}], not in [{unit}]"
    help_ = (f"a number alone is in [{known.unit.interval}]: --uncertain {name}={uncertain.absolute:g}",)
    return Diagnostic("U101", message, span, label=label, help=help_)


def _opaque(rules: Sequence[CompiledRequirement]) -> list[Diagnostic]:
    """Return a finding for each requirement that calls a Python function."""
    findings = []
    for rule in rules:
        for name in dict.fromkeys(call.name for call in rule.formula.calls() if call.opaque):
            message = f"`--uncertain`: `{name}` is a Python function, whose values have no bounds"
            help_ = ("judge the other requirements: --require NAME",)
            findings.append(Diagnostic("U101", message, rule.span, label="calls it", help=help_))
    return findings
