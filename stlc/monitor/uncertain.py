"""Signals that are known up to an error: every sample is an interval, and robustness has bounds.

The bounds hold for all errors of all samples within their limits, each independent of the others. The
evaluators run over the array library of intervals (`stlc.compile.backends.array.interval_ops`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from stlc.compile.backends.array.interval import EPSILON, Floats, Intervals, magnitudes, mul, widened
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.namespace import Array
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import numbers, subexpressions
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.grammar import ast
from stlc.monitor.values import Record
from stlc.registry import closest
from stlc.signature import Column
from stlc.source import Span
from stlc.units import DIMENSIONLESS, Unit, parse_unit, same_dims

_AMOUNT = re.compile(r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>.*)")
_COMPONENT = re.compile(r"(?P<name>.+)\[\d+\]")
_FORM = "an amount with its unit, or a percentage of the value: 0.1m, 2%"


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Greatest error of each sample of a signal.

    Attributes:
        absolute: error in `unit`, 0 or more.
        relative: error as a share of the magnitude of the sample, 0 or more.
        unit: unit of `absolute`; without text it is that of the signal.
    """

    absolute: float = 0.0
    relative: float = 0.0
    unit: Unit = DIMENSIONLESS

    @staticmethod
    def parse(text: str) -> Uncertainty:
        """Return the uncertainty that a text such as `0.1m`, `0.1` or `2%` states.

        Raises:
            ValueError: the text is no amount, or its unit is unknown; the message says what is expected.
        """
        match = _AMOUNT.fullmatch(text.strip())
        if match is None or not math.isfinite(float(match["number"])):
            raise ValueError(f"`{text}` is not {_FORM}")
        number, unit = float(match["number"]), match["unit"].strip()
        if unit == "%":
            return Uncertainty(relative=number / 100.0)
        return Uncertainty(absolute=number, unit=parse_unit(unit) if unit else DIMENSIONLESS)

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
    findings = [found for name, each in uncertain.items() if (found := _misfit(name, each, compiled))]
    findings += _opaque(rules)
    if findings:
        raise UsageError(*findings)
    columns = {column.name: column for column in compiled.signature.columns}
    env: dict[str, Array] = {}
    for name, values in record.env.items():
        known = _of(name, uncertain)
        env[name] = Intervals.point(values) if known is None else _around(values, known, columns[name])
    return replace(record, env=env, ops=INTERVALS, computed=False)


def outer(low: Array, high: Array) -> tuple[Floats, Floats]:
    """Lower end of a lower bound and upper end of an upper bound; numbers are returned unchanged."""
    return (low.low, high.high) if isinstance(low, Intervals) else (low, high)


def _of(name: str, uncertain: Uncertainties) -> Uncertainty | None:
    match = _COMPONENT.fullmatch(name)
    return uncertain.get(name, uncertain.get(match["name"]) if match else None)


def _around(values: Floats, known: Uncertainty, column: Column) -> Intervals:
    """Intervals around samples, in the unit of the signal and rounded outward."""
    centre = Intervals.point(values)
    factor = float(known.unit.ratio / column.unit.ratio) if known.unit.text else 1.0
    share, amount = known.relative * (1.0 + EPSILON), known.absolute * factor * (1.0 + 2.0 * EPSILON)
    if not share and not amount:
        return centre
    error = (mul(magnitudes(centre), share) + amount).high if share else amount
    return widened(values - error, values + error)


# -------------------------------------------------------------------------- what is refused


def _misfit(name: str, uncertain: Uncertainty, compiled: Compiled) -> Diagnostic | None:
    """Return the reason for which a signal cannot have this uncertainty; None if it can."""
    columns = {column.name: column for column in compiled.signature.columns}
    bases = {match["name"]: key for key in columns if (match := _COMPONENT.fullmatch(key))}
    known = columns.get(name) or columns.get(bases.get(name, ""))
    if known is None:
        near = closest(name, [*columns, *bases])
        help_ = (f"did you mean `{near}`?",) if near else ()
        note = (f"signals: {', '.join(columns)}",)
        return Diagnostic("U101", f"`--uncertain {name}=…`: no signal `{name}`", help=help_, note=note)
    span, label = _declaration(name, compiled)
    if known.kind in ("bool", "enum"):
        message = f"`--uncertain {name}=…`: a signal of type {known.kind} has no error"
        return Diagnostic("U101", message, span, label=label)
    unit = uncertain.unit
    if not unit.text or not known.unit.text or same_dims(unit, known.unit.interval):
        return None
    message = f"`--uncertain {name}={uncertain}`: `{name}` is in [{known.unit}], not in [{unit}]"
    help_ = (f"a number alone is in [{known.unit.interval}]: --uncertain {name}={uncertain.absolute:g}",)
    return Diagnostic("U101", message, span, label=label, help=help_)


def _declaration(name: str, compiled: Compiled) -> tuple[Span | None, str]:
    base = match["name"] if (match := _COMPONENT.fullmatch(name)) else name
    for item in compiled.spec.items:
        if isinstance(item, (ast.Signal, ast.Param)) and item.name == base:
            return item.name_span, "declared here"
    return None, ""


def _opaque(rules: Sequence[CompiledRequirement]) -> list[Diagnostic]:
    """Return a finding for each requirement that calls a Python function."""
    findings = []
    for rule in rules:
        parts = (part for num in numbers(rule.formula) for part in subexpressions(num))
        names = dict.fromkeys(
            part.name
            for part in parts
            if isinstance(part, ir.Extern) and not isinstance(part.function, ir.Body)
        )
        for name in names:
            message = f"`--uncertain`: `{name}` is a Python function, whose values have no bounds"
            help_ = ("judge the other requirements: --require NAME",)
            findings.append(Diagnostic("U101", message, rule.span, label="calls it", help=help_))
    return findings
