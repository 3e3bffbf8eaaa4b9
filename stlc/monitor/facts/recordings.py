"""Rules about a recording: signals and columns that look odd, whatever a requirement makes of them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stlc.diagnostics import Diagnostic
from stlc.escape import visible
from stlc.monitor.facts.evidence import Evidence, Floats
from stlc.monitor.facts.fact import Fact
from stlc.signature import Column
from stlc.trace.resample import TimeRange
from stlc.units import Unit

FEW = 10
"""Samples below which a recording is short."""
STUCK = 0.2
"""Share of a recording at its end in which a stuck signal does not change, and `LIVELY` before it."""
LIVELY = 0.5
REST, ALWAYS = 4, 0.98
"""Steps without a change that are told of a signal that changes in this share of all others."""
GAP = 3.0
"""Spans of all other values by which an odd value lies off them."""
FEW = 10
"""Samples below which no value is odd, unless recorders write it for a missing one."""
_NINES = re.compile(r"-?9{2,}|-?32768|32767|65535|2147483647|-2147483648")
"""Numbers that recorders write for a missing value; they are odd from one span on."""
_SUFFIX = re.compile(r"_([A-Za-z]+)$")
_UNITS = {"kmh": "km/h", "kph": "km/h", "mps": "m/s", "ms2": "m/s^2", "mps2": "m/s^2", "degs": "deg/s"}
"""Units as names of columns write them."""
_WORDS = frozenset(("min", "max", "in", "at", *"hdatTACFVgGlL"))
"""Ends of names that are words or letters as often as units."""


def _about(code: str, text: str, evidence: Evidence, signal: str = "", *advice: str) -> Fact:
    place = evidence.declared(signal)
    return Fact(Diagnostic(code, text, place, help=advice), signal=signal)


def _signals(evidence: Evidence, *kinds: str) -> Iterator[tuple[Column, Floats]]:
    """Yield the signals of the given kinds that requirements read, with their recorded values."""
    for column in evidence.read:
        if column.kind in kinds:
            yield column, evidence.values[column.name]


def unchanging(evidence: Evidence) -> Iterator[Fact]:
    """Yield W715 for real signals that are constant, or stuck for a while."""
    for column, values in _signals(evidence, "real"):
        samples, traces = values.shape
        moves = values[1:] != values[:-1]
        if samples < FEW or np.count_nonzero(moves) == moves.size:
            continue
        still = ~moves.any(axis=0)
        last = samples - 1 - np.argmax(moves[::-1], axis=0)
        before = moves.sum(axis=0) / np.maximum(last, 1)
        stuck = ~still & (samples - last > max(STUCK * samples, FEW)) & (before > LIVELY)
        found = still if still.any() else stuck
        trace = int(np.argmax(found))
        first = length = 0
        if traces == 1:  # the longest run of equal values
            edges = np.concatenate([[-1], np.flatnonzero(moves), [len(moves)]])
            rests = np.diff(edges) - 1
            longest = int(np.argmax(rests))
            first, length = int(edges[longest]) + 1, int(rests[longest])
        if found is still:
            told = "throughout"
        elif found.any():
            first = int(last[trace])
            told = f"from {evidence.times[first]:.6g} s to the end, and changed before"
        elif length >= REST and np.count_nonzero(moves) + length >= ALWAYS * len(moves):
            ends = [f"{evidence.times[i]:.6g} s" for i in (first, first + length)]
            told = f"from {ends[0]} to {ends[1]}, and changes at nearly all other samples"
        else:
            continue
        value = f"{float(values[first, trace]):g} {column.unit.text}".rstrip()
        many = f" in {int(found.sum()):,} of {traces:,} traces" if traces > 1 else ""
        yield _about("W715", f"`{visible(column.name)}` is {value} {told}{many}", evidence, column.name)


def odd_values(evidence: Evidence) -> Iterator[Fact]:
    """Yield W716 for the least or the greatest value of a signal, if it is far off all others."""
    for column, values in _signals(evidence, "real", "int"):
        ends = evidence.ranges[column.name]
        for odd in ends if ends[1] > ends[0] else ():
            if not math.isfinite(odd):  # a laser that sees nothing
                continue
            usual = _NINES.fullmatch(f"{odd:.10g}") is not None
            if not usual and values.size < FEW:
                continue
            factor = 1.0 if usual else GAP
            some = _beside(odd, values[:: len(values) // _SAMPLED + 1])
            if some.gap < factor * some.span:
                continue
            rest = _beside(odd, values)
            if not 0.0 < factor * rest.span <= rest.gap:
                continue
            text = (
                f"`{visible(column.name)}` is {odd:.10g} at {values.size - rest.count:,} of {values.size:,} "
                f"samples, elsewhere {rest.low:g} to {rest.high:g}"
            )
            help_ = ("a number for a missing value: write an empty cell or nan",) if usual else ()
            yield _about("W716", text, evidence, column.name, *help_)


_SAMPLED = 1000
"""Samples of a signal that are looked at first: they tell of most signals that no value is odd."""


@dataclass(frozen=True, slots=True)
class _Others:
    """All values but one: their number and range, and the `gap` to the one."""

    count: int
    low: float
    high: float
    gap: float

    @property
    def span(self) -> float:
        return self.high - self.low


def _beside(odd: float, values: Floats) -> _Others:
    others = values[values != odd]
    low, high = (float(end.reduce(others, initial=np.nan)) for end in (np.fmin, np.fmax))
    return _Others(others.size, low, high, min(abs(odd - low), abs(odd - high)))


def object_columns(evidence: Evidence) -> Iterator[Fact]:
    """Yield W717 for columns that look like the name of an object, in a table that is judged as one."""
    if evidence.trace is not None:
        for name, count in evidence.trace.labels.items():
            text = f"column `{visible(name)}` has {count:,} values, as if it told objects apart"
            yield _about("W717", text, evidence, "", f"--group {name}  judges each; --group none  says no")


def few_samples(evidence: Evidence) -> Iterator[Fact]:
    """Yield W718 for recordings of a few samples."""
    samples = evidence.subject.record.samples
    if evidence.trace is not None and samples < FEW:
        yield _about("W718", f"{samples} sample{'s' if samples > 1 else ''} only", evidence)


def known_in_part(evidence: Evidence) -> Iterator[Fact]:
    """Yield W719 for signals that were seen in a part of the recording."""
    subject = evidence.subject
    whole = subject.timeline.duration
    for column, values in _signals(evidence, "real", "int", "bool", "enum"):
        span = subject.signals.spans.get(column.name)
        if span is None and np.isnan(values[[0, -1]]).any():
            known = np.flatnonzero(~np.isnan(values).all(axis=1))
            span = TimeRange(*(subject.time(int(i)) for i in known[[0, -1]])) if len(known) else None
        if span is not None and (span.first > whole.first or span.last < whole.last):
            first, last = span.first - whole.first, span.last - whole.first
            text = f"`{visible(column.name)}` is known from {first:.6g} s to {last:.6g} s only"
            yield _about("W719", text, evidence, column.name)


def hidden_columns(evidence: Evidence) -> Iterator[Fact]:
    """Yield W720 where `--map` hides a column of the signal's own name."""
    trace = evidence.trace
    if trace is None:
        return
    for signal, source in trace.sources.items():
        if signal in trace.others and signal in evidence.values:
            text = f"`{signal}` is read from `{source}`, and `{trace.name}` has a column `{signal}` too"
            yield _about("W720", text, evidence, signal, f"leave out  --map {signal}={source}")


def units_in_names(evidence: Evidence) -> Iterator[Fact]:
    """Yield W721 for columns whose name says another unit than the signal has."""
    trace = evidence.trace
    if trace is None:
        return
    for column, _ in _signals(evidence, "real", "int"):
        source = trace.sources.get(column.name, column.name)
        stated = column.name in trace.signature and trace.signature[column.name].unit.text
        named = None if stated or not column.unit.text else _unit_of(source)
        if named is None or not named.same_dims(column.unit):
            continue
        if (named.ratio, named.offset) != (column.unit.ratio, column.unit.offset):
            text = f"`{visible(source)}` is read as [{column.unit.text}], and its name says [{named.text}]"
            advice = f"state the unit in the header:  {source} [{named.text}]"
            yield _about("W721", text, evidence, column.name, advice)


def _unit_of(name: str) -> Unit | None:
    """Unit at the end of the name of a column, such as `gap_mm`; None if there is none."""
    found = _SUFFIX.search(name.partition("[")[0])
    if found is None or found[1] in _WORDS:
        return None
    try:
        return Unit.parse(_UNITS.get(found[1].lower(), found[1]))
    except ValueError:
        return None


def degrees(evidence: Evidence) -> Iterator[Fact]:
    """Yield W722 for signals in radians with values that are an angle only in degrees."""
    turn, radians = 2.0 * np.pi, Unit.parse("rad")
    for column, _ in _signals(evidence, "real"):
        unit = column.unit
        if unit.text != "rad" or not unit.same_dims(radians):
            continue
        least, most = evidence.ranges[column.name]
        reach = max(most, -least)
        if 2.0 * turn < reach <= 360.0:
            text = f"`{visible(column.name)}` in [rad] reaches {reach:.4g}"
            advice = f"signal {column.name} [deg]  if it is in degrees"
            yield _about("W722", text, evidence, column.name, advice)
