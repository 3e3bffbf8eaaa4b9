"""Online monitoring: the standard input, and files larger than memory, read in chunks.

The lines of the standard input are a `.csv` with a header, or one JSON object each. The time step is that of
`--dt`, of the first two values of `t`, or of the system; `--resample` puts any times on a grid.
"""

from __future__ import annotations

import hashlib
import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stlc.cli.check.document import cause_entry, gap_entry
from stlc.cli.check.judge import Question, Work, instant_of, laid_reading, monitor_of, specification, usage
from stlc.cli.check.outcome import WORDS, Outcome, VerdictRow
from stlc.cli.check.text import in_unit, percent, signed
from stlc.cli.framework.output import emit, table, wants_color
from stlc.cli.framework.render import render_place
from stlc.compile.ir.support import columns
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.diagnostics import Diagnostic, TraceError
from stlc.escape import visible
from stlc.files import find_spec, read_source
from stlc.monitor.judgement import beside
from stlc.monitor.signals import gap_text
from stlc.source import Source

if TYPE_CHECKING:
    from stlc.monitor.explain.report import Cause
    from stlc.monitor.judgement import Status
    from stlc.monitor.online.online import Decision, Online
    from stlc.monitor.online.tally import Tally
    from stlc.monitor.signals import Conversion
    from stlc.monitor.verdict import Monitor
    from stlc.trace.live import Sample, Uniform


@dataclass(frozen=True, slots=True)
class Told:
    """Description of a stream.

    Attributes:
        name: of the trace.
        source: text of the specification.
        dt: time step in seconds.
        samples: their number.
        color: print reasons in colours.
    """

    name: str
    source: Source
    dt: float
    samples: int
    color: bool = False


def outcome_of_tallies(online: Online, told: Told, said: tuple[str, ...], seconds: float) -> Outcome:
    """The outcome of a finished stream. Raises TraceError as `Online.finish`."""
    tallies = online.finish()
    status = status_of(online, tallies)
    causes = {
        name: cause
        for name, tally in tallies.items()
        if tally.status == "violated" and (cause := online.cause(name)) is not None
    }
    rows = tuple(_row(name, tally, online, causes.get(name)) for name, tally in tallies.items())
    counts = [tally.instants for tally in tallies.values()]
    most = max(tallies.values(), key=lambda tally: tally.instants)
    return Outcome(
        name=told.name,
        status=status,
        rows=rows,
        text="\n".join([*_text(told, online, rows, tallies, causes), "", WORDS[status].lower()]),
        entry=_entry(told, online, tallies, status)
        | {"requirements": _requirements(online, tallies, causes)},
        traces=0 if status == "out of scope" else 1,
        holds=min(tally.share for tally in tallies.values()) if counts else 0.0,
        fails=max(tally.fails / max(tally.instants, 1) for tally in tallies.values()) if most else 0.0,
        seconds=seconds,
        warnings=online.compiled.warnings,
        said=said,
    )


def status_of(online: Online, tallies: Mapping[str, Tally]) -> Status:
    """Status over all requirements."""
    if online.in_scope is False:
        return "out of scope"
    found = {tally.status for tally in tallies.values()}
    return "violated" if "violated" in found else "satisfied" if found == {"satisfied"} else "inconclusive"


def robustness_text(tally: Tally, unit: str) -> str:
    """The least robustness, or its bounds."""
    if tally.status == "inconclusive":
        return in_unit(f"[{signed(tally.low)}, {signed(tally.high)}]", unit)
    near = abs(tally.robustness) <= TOLERANCE
    return "boundary" if near else in_unit(signed(tally.robustness), unit)


def _row(name: str, tally: Tally, online: Online, cause: Cause | None) -> VerdictRow:
    where = f"from t = {online.time(tally.worst):.10g} s" if tally.instants > 1 else ""
    unit = online.rule(name).unit or ("" if cause is None else cause.unit)
    value = robustness_text(tally, unit)
    if cause is not None:
        start = online.time(tally.worst) if tally.instants > 1 else cause.time
        where = beside(f"t = {cause.time:.10g} s", f"t = {start:.10g} s")
        return VerdictRow(name, tally.status, value, where, cause.because)
    if tally.status == "satisfied":
        return VerdictRow(name, tally.status, value, where)
    if tally.status == "violated":
        why = f"violated at {tally.fails:,} of {tally.instants:,} starts"
    else:
        read = columns(online.rule(name).formula)
        gaps = [text for signal, text in _gap_texts(online).items() if signal in read]
        why = ", ".join(gaps) or "the trace is too short to say"
    return VerdictRow(name, tally.status, value, where, why)


def _gap_texts(online: Online) -> dict[str, str]:
    """Unknown samples, one line per signal."""
    return {
        name: gap_text(name, gap, online.samples, (_moment(online, gap.first), _moment(online, gap.last)))
        for name, gap in online.gaps.items()
    }


def _moment(online: Online, sample: int) -> str:
    return f"t = {online.time(sample):.10g} s"


def _text(
    told: Told,
    online: Online,
    rows: tuple[VerdictRow, ...],
    tallies: Mapping[str, Tally],
    causes: Mapping[str, Cause],
) -> Iterator[str]:
    head = f"{visible(told.source.name)} on {visible(told.name)}"
    yield f"{head}    1 trace x {told.samples} samples, dt {told.dt:g} s"
    yield ""
    columns = ("requirement", "verdict", "robustness", "starts", "where")
    lines = [
        (row.name, WORDS[row.status], row.robustness, _share(tallies[row.name]), row.where) for row in rows
    ]
    yield table(lines, header=columns)
    for gap in _gap_texts(online).values():
        yield f"  {gap}"
    for row in rows:
        if row.status == "inconclusive":
            yield ""
            yield f"{visible(row.name)} is inconclusive: {row.why}."
    for name, cause in causes.items():
        yield ""
        yield _violation(name, tallies[name], cause, color=told.color)


def _violation(name: str, tally: Tally, cause: Cause, *, color: bool) -> str:
    count = f", at {tally.fails:,} of {tally.instants:,} starts" if tally.instants > 1 else ""
    place = render_place(cause.place, cause.labels, [("because", cause.because)], color=color)
    return f"{visible(name)} is violated{count}.\n{place}".rstrip("\n")


def _share(tally: Tally) -> str:
    return "" if tally.instants == 1 else percent(tally.share)


def _entry(told: Told, online: Online, tallies: Mapping[str, Tally], status: Status) -> dict[str, Any]:
    horizon = online.compiled.grid.horizon
    known = [tally.robustness for tally in tallies.values()]
    return {
        "trace": told.name,
        "spec": told.source.name,
        "spec_sha256": hashlib.sha256(told.source.text.encode()).hexdigest(),
        "dt": told.dt,
        "horizon": None if horizon is None else {"seconds": horizon * told.dt, "steps": horizon},
        "end": online.how.end,
        "traces": 1,
        "samples": told.samples,
        "unknown": {name: gap_entry(gap, online.time) for name, gap in online.gaps.items()},
        "in_scope": int(online.in_scope is not False),
        "verdict": status,
        "robustness": math.nan if any(map(math.isnan, known)) else min(known),
        "satisfied_traces": int(status == "satisfied"),
        "satisfied_share": min(tally.share for tally in tallies.values()),
    }


def _requirements(
    online: Online, tallies: Mapping[str, Tally], causes: Mapping[str, Cause]
) -> list[dict[str, Any]]:
    return [_requirement(name, tally, online, causes.get(name)) for name, tally in tallies.items()]


def _requirement(name: str, tally: Tally, online: Online, cause: Cause | None) -> dict[str, Any]:
    rule = online.rule(name)
    time = online.time(tally.worst)
    return {
        "name": name,
        "doc": rule.doc,
        "tags": sorted(rule.tags),
        "verdict": tally.status,
        "robustness": {
            "min": tally.robustness,
            "mean": tally.robustness,
            "low": tally.low,
            "high": tally.high,
            "unit": rule.unit or ("" if cause is None else cause.unit),
            "argmin": {"trace": 0, "start": time, "time": time if cause is None else cause.time},
        },
        "starts": tally.instants,
        "satisfied_share": tally.share,
        "violated_traces": int(tally.status == "violated"),
        "cause": None if cause is None else cause_entry(cause),
    }


NAME = "standard input"
CLOCK = "t"


def outcome_of_stream(question: Question, *, talk: bool) -> Outcome:
    """Judge the standard input; with `talk`, print verdicts as soon as they are decided.

    Raises:
        UsageError: U101, no specification, or an option that needs the whole trace.
        TraceError: a line is not a sample, or signals are missing or not finite.
    """
    from stlc.trace.live import MAX_LINE, SampleStream, on_grid

    if question.spec is None:
        raise usage("which specification?", "stlc check SPEC -")
    if question.semantics != "exact":
        raise usage("`--semantics` needs the whole trace, and the standard input is judged line by line")
    begun = time.perf_counter()
    source = read_source(find_spec(question.spec))
    monitor = monitor_of(source, question)
    reading = laid_reading(monitor, question)
    lines = SampleStream(NAME, reading)
    raw = iter(lambda: sys.stdin.buffer.readline(MAX_LINE + 1), b"")
    uniform = on_grid(lines.moments(raw), reading, NAME)
    online = _online(monitor, question, uniform)
    changes = _conversions(online, lines.units)
    for sample in uniform.samples:
        try:
            decisions = online.push(_in_units(sample, changes, online))
        except TraceError as error:
            where = f"sample {online.samples} of the {NAME}"
            raise TraceError(*(finding.with_note(where) for finding in error.diagnostics)) from None
        if talk:
            for decision in decisions:
                _tell(decision, online)
    step = online.compiled.grid.dt
    told = Told(NAME, source, float(step or 0), online.samples, wants_color(sys.stdout))
    return outcome_of_tallies(online, told, (), time.perf_counter() - begun)


def _online(monitor: Monitor, question: Question, uniform: Uniform) -> Online:
    from stlc.monitor.online.online import How

    known = monitor.online(How(), require=question.require, dt=uniform.dt).compiled.grid.dt
    at = instant_of(question.at, f"the {NAME}", float(known or 0), uniform.t0, None)
    how = How(at, question.end, question.tolerance, uniform.t0, reasons=True)
    return monitor.online(how, require=question.require, dt=uniform.dt)


def _conversions(online: Online, units: Mapping[str, str]) -> dict[str, Conversion]:
    """Conversions of recorded numbers to the declared units, where these differ.

    Raises:
        TraceError: E605, an invalid unit, or one of another dimension.
    """
    from stlc.monitor.signals import conversion
    from stlc.units import CELSIUS, means_celsius, parse_unit

    changes: dict[str, Conversion] = {}
    for column in online.compiled.signature.columns:
        if not units.get(column.name):
            continue
        try:
            recorded = parse_unit(units[column.name])
        except ValueError as error:
            message = f"column `{column.name}` of the {NAME}: {error}"
            help_ = (CELSIUS,) if means_celsius(units[column.name]) else ()
            raise TraceError(Diagnostic("E605", message, help=help_)) from None
        change = conversion(NAME, column, recorded)
        if change is not None:
            changes[column.name] = change
    return changes


def _in_units(sample: Sample, changes: Mapping[str, Conversion], online: Online) -> Sample:
    """The sample in declared units, and its time."""
    converted = {name: change(sample[name]) for name, change in changes.items() if name in sample}
    return {CLOCK: online.time(online.samples), **sample, **converted}


def _tell(decision: Decision, online: Online) -> None:
    """Print a violation always, satisfaction only of a requirement that is judged once."""
    repeated = online.repeats(decision.requirement)
    if decision.status == "satisfied" and repeated:
        return
    low, high = decision.low, decision.high
    bounds = signed(low) if low == high else f"[{signed(low)}, {signed(high)}]"
    value = in_unit(bounds, online.rule(decision.requirement).unit)
    judged = f", judged from t = {decision.time:.10g} s" if repeated else ""
    now = online.time(decision.sample)
    emit(f"t = {now:.10g} s  {visible(decision.requirement)}  {WORDS[decision.status]}  {value}{judged}")


CHUNK = 250_000
"""Samples per chunk."""


def outcome_in_chunks(path: Path, work: Work) -> Outcome:
    """Judge a file in chunks.

    Raises:
        UsageError: U101, an option that needs the whole trace.
        TraceError: as `stlc.trace.chunks.pieces`.
    """
    from stlc.monitor.online.online import How
    from stlc.trace.chunks import pieces

    question = work.question
    _require_pieces(path, work)
    begun = time.perf_counter()
    given = None if question.spec is None else monitor_of(read_source(find_spec(question.spec)), question)
    read = pieces(path, work.chunk or CHUNK, laid_reading(given, question))
    first = next(read)
    source, note = specification(str(path), question.spec, first.meta.carried)
    monitor = given or monitor_of(source, question, first.meta.carried)
    at = instant_of(question.at, str(path), first.dt, first.t0, None)
    how = How(at, question.end, question.tolerance, first.t0, reasons=True)
    online = monitor.online(how, require=question.require, like=first)
    online.feed(first)
    for piece in read:
        online.feed(piece)
    told = Told(str(path), source, first.dt, online.samples, work.color)
    return outcome_of_tallies(online, told, (note,) if note else (), time.perf_counter() - begun)


def _require_pieces(path: Path, work: Work) -> None:
    """Raise UsageError for options that need all samples at once."""
    question = work.question
    whole = {
        "--resample": question.resample is not None,
        "--max-gap": question.max_gap is not None,
        "--out": work.out is not None,
        "--semantics": question.semantics != "exact",
    }
    advice = "leave out --chunk" if work.chunk else "cut out what is of interest"
    for option, asked in whole.items():
        if asked:
            raise usage(f"`{option}` needs the whole trace, and `{path}` is read in pieces", advice)
