"""Online monitoring: samples from the standard input, and files larger than memory, read in chunks.

The standard input is a `.csv` with a header, or has one JSON object per line. The time step is the value of
`--dt`. Without that option it is the difference of the first two values of `t`; without times, it is the time
step of the system. With `--resample`, samples may be irregular in time; they are resampled to a uniform grid.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.check.document import fact_records, part_record, requirement_record, trace_record
from stlc.cli.check.judge import Question, Work, instant_of, monitor_of, reading_options, specification
from stlc.cli.check.outcome import WORDS, Outcome, VerdictRow
from stlc.cli.check.text import in_unit, percent, robustness_text, signed, text_of
from stlc.cli.framework.documents import CheckedRequirement
from stlc.cli.framework.output import emit, wants_color
from stlc.cli.framework.render import render_place
from stlc.compile.ir.support import columns
from stlc.diagnostics import Diagnostic, TraceError, usage
from stlc.escape import visible
from stlc.files import find_spec, read_source
from stlc.monitor.facts.extent import samples_read
from stlc.monitor.facts.requirements import part_facts
from stlc.monitor.facts.rules import unsilenced
from stlc.monitor.judgement import beside
from stlc.monitor.signals import gap_text
from stlc.source import Source
from stlc.trace.resample import TimeRange

if TYPE_CHECKING:
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.monitor.explain.report import Cause
    from stlc.monitor.judgement import Status
    from stlc.monitor.online.online import Decision, Online
    from stlc.monitor.online.tally import RequirementSummary
    from stlc.monitor.verdict import Monitor
    from stlc.trace.live import Sample, Uniform
    from stlc.trace.recording import Conversion


def _outcome(
    online: Online,
    name: str,
    source: Source,
    dt: float,
    *,
    color: bool,
    remarks: tuple[str, ...],
    begun: float,
) -> Outcome:
    """Finish the monitoring of a stream and return its outcome.

    Args:
        online: monitor that has received all samples.
        name: name of the stream in the outcome.
        source: text of the specification.
        dt: time step in seconds.
        color: whether the text of the outcome has colour codes.
        remarks: messages for the user, copied to the outcome.
        begun: value of `time.perf_counter()` when the monitoring began.

    Raises:
        TraceError: E306, the trace is too short and `--end strict` was given; E605, there is no sample.
    """
    tallies = online.finish()
    found = {tally.status for tally in tallies.values()}
    status: Status = "violated" if "violated" in found else "inconclusive"
    status = "satisfied" if found == {"satisfied"} else status
    if online.in_scope is False:
        status = "out of scope"
    causes = {
        rule: cause
        for rule, tally in tallies.items()
        if tally.status == "violated" and (cause := online.cause(rule)) is not None
    }
    gaps = {
        signal: gap_text(signal, gap, online.samples, (_moment(online, gap.first), _moment(online, gap.last)))
        for signal, gap in online.gaps.items()
    }
    rows = tuple(_row(rule, tally, online, causes.get(rule), gaps) for rule, tally in tallies.items())
    reasons = [
        f"{visible(row.name)} is inconclusive: {row.why}." for row in rows if row.status == "inconclusive"
    ]
    reasons += [_violation(rule, tallies[rule], cause, color=color) for rule, cause in causes.items()]
    title = f"{visible(source.name)} on {visible(name)}    1 trace x {online.samples} samples, dt {dt:g} s"
    known = [tally.robustness for tally in tallies.values()]
    share = min(tally.share for tally in tallies.values())
    return Outcome(
        name=name,
        entry=trace_record(
            name,
            source,
            dt,
            online.compiled.grid.horizon,
            online.gaps,
            online.time,
            end=online.how.end,
            traces=1,
            samples=online.samples,
            in_scope=int(status != "out of scope"),
            verdict=status,
            robustness=math.nan if any(map(math.isnan, known)) else min(known),
            satisfied_traces=int(status == "satisfied"),
            satisfied_share=share,
            requirements=[_requirement(row, tallies[row.name], online, causes.get(row.name)) for row in rows],
        ),
        status=status,
        rows=rows,
        text=text_of(title, rows, gaps.values(), reasons, [WORDS[status].lower()]),
        traces=int(status != "out of scope"),
        holds=share,
        fails=max(tally.fails / max(tally.instants, 1) for tally in tallies.values()),
        seconds=time.perf_counter() - begun,
        warnings=online.compiled.warnings,
        remarks=remarks,
    )


def _row(
    name: str, tally: RequirementSummary, online: Online, cause: Cause | None, gaps: Mapping[str, str]
) -> VerdictRow:
    rule = online.rule(name)
    where = f"from {_moment(online, tally.worst)}" if tally.instants > 1 else ""
    unit = rule.unit or ("" if cause is None else cause.unit)
    value = robustness_text(tally.status, tally.low, tally.high, tally.robustness, unit, online.how.tolerance)
    share = "" if tally.instants == 1 else percent(tally.share)
    why = ""
    if cause is not None:
        at = f"t = {cause.shown_time:.10g} s"
        where, why = beside(at, _moment(online, tally.worst) if tally.instants > 1 else at), cause.because
    elif tally.status == "violated":
        why = f"violated at {tally.fails:,} of {tally.instants:,} starts"
    elif tally.status == "inconclusive":
        needed = columns(rule.formula)
        why = ", ".join(text for signal, text in gaps.items() if signal in needed)
        short = tally.first + tally.instants - 1 + rule.reach >= online.samples
        why = why or ("the trace is too short to say" if short else "it has no value where it was judged")
    least = tally.low if tally.status == "inconclusive" else tally.robustness
    facts = unsilenced([*part_facts(rule, _parts(tally, online, rule), _duration(online))])
    return VerdictRow(name, tally.status, value, share, where, why, least, unit, facts=facts)


def _parts(tally: RequirementSummary, online: Online, rule: CompiledRequirement) -> list[TimeRange]:
    """Times in seconds at which a requirement could read the stream; empty for all of it."""
    starts = range(tally.first, tally.first + tally.instants)
    ranges = samples_read(rule.formula, starts, online.samples)
    return [TimeRange(online.time(each.start), online.time(each.stop - 1)) for each in ranges]


def _duration(online: Online) -> TimeRange:
    return TimeRange(online.time(0), online.time(online.samples - 1))


def _moment(online: Online, sample: int) -> str:
    return f"t = {online.time(sample):.10g} s"


def _violation(name: str, tally: RequirementSummary, cause: Cause, *, color: bool) -> str:
    count = f", at {tally.fails:,} of {tally.instants:,} starts" if tally.instants > 1 else ""
    place = render_place(cause.place, cause.labels, [("because", cause.because)], color=color)
    return f"{visible(name)} is violated{count}.\n{place}".rstrip("\n")


def _requirement(
    row: VerdictRow, tally: RequirementSummary, online: Online, cause: Cause | None
) -> CheckedRequirement:
    least, rule = tally.robustness, online.rule(row.name)
    return requirement_record(
        rule,
        cause,
        {"min": least, "mean": least, "low": tally.low, "high": tally.high},
        0,
        online.time(tally.worst),
        verdict=tally.status,
        starts=tally.instants,
        satisfied_share=tally.share,
        violated_traces=int(tally.status == "violated"),
        judged=part_record(_parts(tally, online, rule), _duration(online)),
        facts=fact_records(row.facts),
    )


NAME = "standard input"
CLOCK = "t"


def outcome_of_stream(question: Question, *, talk: bool) -> Outcome:
    """Judge the standard input; with `talk`, print each verdict as soon as it is decided.

    Raises:
        UsageError: U101, there is no specification, or an option needs the whole trace.
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
    reading = reading_options(monitor, question)
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
    step, color = float(online.compiled.grid.dt or 0), wants_color(sys.stdout)
    outcome = _outcome(online, NAME, source, step, color=color, remarks=(), begun=begun)
    if not (aside := uniform.aside()):
        return outcome
    message = f"samples of the {NAME} between the instants of the grid are not judged: {aside:,}"
    finding = Diagnostic("W305", message, help=("stlc check SPEC FILE  judges every sample of a recording",))
    return replace(outcome, warnings=(finding, *outcome.warnings))


def _online(monitor: Monitor, question: Question, uniform: Uniform) -> Online:
    from stlc.monitor.online.online import How

    known = monitor.online(How(), require=question.require, dt=uniform.dt).compiled.grid.dt
    at = instant_of(question.at, f"the {NAME}", float(known or 0), uniform.t0, None)
    how = How(at, question.end, question.tolerance, uniform.t0, reasons=True)
    return monitor.online(how, require=question.require, dt=uniform.dt)


def _conversions(online: Online, units: Mapping[str, str]) -> dict[str, Conversion]:
    """Return the unit conversions of the standard input: signal -> function that converts its values.

    `units` gives the unit of each recorded signal. The values are converted to the unit that the
    specification declares. A signal that needs no conversion is left out.

    Raises:
        TraceError: E605, a unit is invalid, or has another dimension than the declared one.
    """
    from stlc.trace.recording import conversion
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
    """Return `sample` with its values converted to the units that the specification declares.

    `changes` maps the name of a signal to the function that converts its values. If the sample has no time,
    its time is added. This time follows from the time step and the number of samples before it.
    """
    converted = {name: change(sample[name]) for name, change in changes.items() if name in sample}
    return {CLOCK: online.time(online.samples), **sample, **converted}


def _tell(decision: Decision, online: Online) -> None:
    """Print the verdict `decision`, which the monitor `online` has just reached.

    For a requirement that is judged at many instants, only violations are printed.
    """
    repeated = online.repeats(decision.requirement)
    if decision.status == "satisfied" and repeated:
        return
    low, high = decision.low, decision.high
    bounds = signed(low) if low == high else f"[{signed(low)}, {signed(high)}]"
    value = in_unit(bounds, online.rule(decision.requirement).unit)
    judged = f", judged from t = {decision.time:.10g} s" if repeated else ""
    now = _moment(online, decision.sample)
    emit(f"{now}  {visible(decision.requirement)}  {WORDS[decision.status]}  {value}{judged}")


CHUNK = 250_000
"""Samples per chunk."""


def outcome_in_chunks(path: Path, work: Work) -> Outcome:
    """Judge the file `path`, which is read in chunks of samples, with the options in `work`.

    Raises:
        UsageError: U101, an option needs the whole trace at once.
        TraceError: the file cannot be read in chunks, or its samples are invalid; see
            `stlc.trace.chunks.pieces`.
    """
    from stlc.monitor.online.online import How
    from stlc.trace.chunks import pieces

    question = work.question
    _require_pieces(path, work)
    begun = time.perf_counter()
    given = None if question.spec is None else monitor_of(read_source(find_spec(question.spec)), question)
    read = pieces(path, work.chunk or CHUNK, reading_options(given, question))
    first = next(read)
    source, note = specification(str(path), question.spec, first.meta.carried)
    monitor = given or monitor_of(source, question, first.meta.carried)
    at = instant_of(question.at, str(path), first.dt, first.t0, None)
    how = How(at, question.end, question.tolerance, first.t0, reasons=True)
    online = monitor.online(how, require=question.require, like=first)
    online.feed(first)
    for piece in read:
        online.feed(piece)
    remarks = (note,) if note else ()
    return _outcome(online, str(path), source, first.dt, color=work.color, remarks=remarks, begun=begun)


def _require_pieces(path: Path, work: Work) -> None:
    """Raise UsageError (U101) if the options in `work` need all samples of the file `path` together.

    An example is `--resample`.
    """
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
