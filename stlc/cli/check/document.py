"""Machine-readable results of `stlc check`: JSON, JUnit XML, and robustness as a trace."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from stlc.cli.check.outcome import Checked, Outcome, overall
from stlc.cli.framework import documents
from stlc.cli.framework.assured import UncertainSignal
from stlc.cli.framework.documents import record
from stlc.escape import xml
from stlc.monitor.explain.report import Cause
from stlc.monitor.facts.fact import Fact
from stlc.monitor.facts.requirements import parts_read
from stlc.monitor.judgement import Judgement
from stlc.monitor.signals import Gap
from stlc.provenance import sha256
from stlc.trace.resample import TimeRange

if TYPE_CHECKING:
    from stlc.cli.check.judge import Question
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.source import Source


def document(outcomes: Sequence[Outcome]) -> documents.CheckResult:
    """JSON document that `stlc check --json` prints.

    For one file it is the record of that file; for several files, the overall verdict and the list of their
    records.
    """
    entries = [outcome.entry for outcome in outcomes]
    only: Any = entries[0]
    return only if len(entries) == 1 else {"verdict": overall(outcomes), "files": entries}


def _errors(result: Checked) -> dict[str, Any]:
    """Entry `uncertain` of a record: the greatest error of each signal with errors; none without errors."""
    if not result.uncertain:
        return {}
    errors = {
        name: record(UncertainSignal, error, unit=error.unit.text) for name, error in result.uncertain.items()
    }
    return {"uncertain": errors}


def result_record(result: Checked, end: str) -> documents.CheckedTrace:
    """JSON record of the judged trace `result`, whose samples were all in memory.

    `end` is the value of the option `--end`: the treatment of traces that are too short.
    """
    verdict = result.verdict
    return trace_record(
        result.trace.name,
        result.source,
        result.trace.dt,
        verdict.subject.horizon,
        verdict.subject.gaps,
        verdict.subject.time,
        end=end,
        **_errors(result),
        traces=verdict.traces,
        samples=result.trace.samples,
        in_scope=verdict.in_scope,
        verdict=verdict.overall if verdict.in_scope else "out of scope",
        robustness=_least(verdict.requirements[0].counted(np.atleast_1d(verdict.robustness))),
        satisfied_traces=verdict.satisfied_traces,
        satisfied_share=verdict.share,
        requirements=[_requirement(judged, result) for judged in verdict],
        clocks=[
            record(documents.ClockRecord, clock, others=list(clock.others)) for clock in result.trace.clocks
        ],
        facts=fact_records(result.facts_on("")),
        lint=sorted(set(result.lint)),
    )


def trace_record(
    name: str,
    source: Source,
    dt: float,
    horizon: int | None,
    gaps: Mapping[str, Gap],
    time: Callable[[int], float],
    **found: object,
) -> documents.CheckedTrace:
    """JSON record of a judged trace, made of the given parts.

    Args:
        name: name of the trace.
        source: text of the specification.
        dt: time step in seconds.
        horizon: number of steps of the horizon `T`, if known.
        gaps: signal -> number and range of its unknown samples.
        time: function that maps the index of a sample to its time in seconds.
        found: all other keys of the record and their values, such as `verdict`.
    """
    made: Any = {
        "trace": name,
        "spec": source.name,
        "spec_sha256": sha256(source.text),
        "dt": dt,
        "horizon": None if horizon is None else {"seconds": horizon * dt, "steps": horizon},
        "unknown": {
            signal: {"samples": gap.samples, "first": time(gap.first), "last": time(gap.last)}
            for signal, gap in gaps.items()
        },
        **found,
    }
    return record(documents.CheckedTrace, None, **made)


def _requirement(judged: Judgement, result: Checked) -> documents.CheckedRequirement:
    low, high, least = (judged.counted(end) for end in (*judged.margins, judged.least))
    trace, sample = judged.worst
    return requirement_record(
        judged.rule,
        result.causes.get(judged.name),
        {"min": _least(least), "mean": _mean(least), "low": _least(low), "high": _least(high)},
        trace,
        result.verdict.subject.time(sample),
        verdict=judged.overall,
        starts=judged.instants,
        satisfied_share=judged.share,
        violated_traces=judged.statuses.count("violated"),
        judged=_part(judged, result),
        facts=fact_records(result.facts_on(judged.name)),
    )


def fact_records(facts: Iterable[Fact]) -> list[documents.FactRecord]:
    """JSON records of facts."""
    return [record(documents.FactRecord, fact, advice=list(fact.advice)) for fact in facts]


def _part(judged: Judgement, result: Checked) -> documents.JudgedPart | None:
    """The part of the recording that a requirement could read, in mission time; None for all of it."""
    subject = result.verdict.subject
    return part_record(parts_read(judged, subject), subject.duration)


def part_record(parts: Sequence[TimeRange], whole: TimeRange) -> documents.JudgedPart | None:
    """JSON record of the parts of a recording that a requirement could read; None for all of it."""
    if not parts:
        return None
    first, last = parts[0].first - whole.first, parts[-1].last - whole.first
    return {"first": first, "last": last, "of": whole.last - whole.first}


def requirement_record(
    rule: CompiledRequirement,
    cause: Cause | None,
    margins: Mapping[str, float | None],
    trace: int,
    start: float,
    **found: object,
) -> documents.CheckedRequirement:
    """JSON record of a judged requirement.

    Args:
        rule: the requirement.
        cause: cause of its violation, if any.
        margins: key -> number, for statistics of the robustness such as its minimum or mean.
        trace: index of the trace with the least robustness.
        start: time in seconds at which the requirement has its least robustness.
        found: further keys of the record and their values, on the verdict and the counts.
    """
    robustness = {
        **margins,
        "unit": rule.unit or ("" if cause is None else cause.unit),
        "argmin": {"trace": trace, "start": start, "time": start if cause is None else cause.time},
    }
    told = None if cause is None else _cause(cause)
    made = {"tags": sorted(rule.tags), "robustness": robustness, "cause": told, **found}
    if rule.typed.id:
        made["id"] = rule.typed.id
    return record(documents.CheckedRequirement, rule, **made)


def _least(values: NDArray[np.float64]) -> float | None:
    return float(values.min()) if values.size else None


def _mean(values: NDArray[np.float64]) -> float | None:
    """Return the mean of `values`; None if there are none.

    The sum of the values could overflow. So each value is divided by the number of values before they are
    added.
    """
    with np.errstate(invalid="ignore"):  # +inf and -inf have no mean
        return float((values / values.size).sum()) if values.size else None


def _cause(cause: Cause) -> documents.CauseRecord:
    first = cause.readings[0] if cause.readings else None
    return record(
        documents.CauseRecord,
        cause,
        signal=None if first is None else first.signal,
        value=None if first is None else first.value,
        readings=[record(documents.ReadingRecord, reading) for reading in cause.readings],
        span=record(documents.PlaceRecord, cause.span),
        requirement=record(documents.PlaceRecord, cause.place.span),
    )


def junit(outcomes: Sequence[Outcome], *, strict: bool = False) -> str:
    """The results as a JUnit XML document; with `strict`, what was not fully judged is skipped."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f"<testsuites{_counts(outcomes, strict=strict)}>"]
    for outcome in outcomes:
        lines += _suite(outcome, strict=strict)
    return "\n".join([*lines, "</testsuites>", ""])


def _counts(outcomes: Sequence[Outcome], *, strict: bool) -> str:
    rows = [row for outcome in outcomes for row in outcome.rows]
    errors = sum(bool(outcome.errors) for outcome in outcomes)
    failures = sum(row.status == "violated" for row in rows)
    skipped = sum(row.status in ("inconclusive", "out of scope") or (strict and row.unjudged) for row in rows)
    seconds = sum(outcome.seconds for outcome in outcomes)
    return (
        f' tests="{len(rows) + errors}" failures="{failures}" errors="{errors}" skipped="{skipped}"'
        f' time="{seconds:.3f}"'
    )


def _suite(outcome: Outcome, *, strict: bool) -> Iterator[str]:
    yield f"  <testsuite name={_attribute(outcome.name)}{_counts([outcome], strict=strict)}>"
    for error in outcome.errors[:1]:
        yield f'    <testcase classname={_attribute(outcome.name)} name="trace">'
        detail = xml("\n".join(f"{e.code}: {e.message}" for e in outcome.errors))
        kind, message = _attribute(error.code), _attribute(error.message)
        yield f"      <error type={kind} message={message}>{detail}</error>"
        yield "    </testcase>"
    for row in outcome.rows:
        head = f"    <testcase classname={_attribute(outcome.name)} name={_attribute(row.name)}"
        told = "\n".join([row.verdict, *row.remarks]) if row.facts else ""
        if row.status == "satisfied" and not told:
            yield f"{head}/>"
            continue
        yield f"{head}>"
        if row.status == "violated":
            message = f"robustness {row.robustness}{', ' + row.where if row.where else ''}"
            yield f'      <failure type="violated" message={_attribute(message)}>{xml(row.why)}</failure>'
        elif row.status != "satisfied":
            yield f"      <skipped message={_attribute(row.why or row.status)}/>"
        elif strict and row.unjudged:
            yield f"      <skipped message={_attribute(told)}/>"
        if told:
            yield f"      <system-out>{xml(told)}</system-out>"
        yield "    </testcase>"
    if outcome.facts:
        told = "\n".join(fact.text for fact in outcome.facts)
        yield f"    <system-out>{xml(told)}</system-out>"
    yield "  </testsuite>"


def _attribute(text: str) -> str:
    return f'"{xml(text)}"'


def write_robustness(path: Path, result: Checked, question: Question) -> None:
    """Write the robustness of each requirement to the trace file `path`, one signal per requirement.

    `result` is the judged trace, and `question` the options with which it was judged. A signal has the shape
    (traces, samples). Its value at a sample is the robustness of the requirement at that instant, or NaN
    where the robustness is not defined.

    Raises:
        MissingError: R201, the disk is full, or the user may not write there.
    """
    from dataclasses import replace

    from stlc.cli.check.judge import monitor_of
    from stlc.signature import Column, Signature
    from stlc.trace import Trace, save_trace
    from stlc.units import written_unit

    trace = result.trace
    monitor = monitor_of(result.source, question, result.trace.meta.carried)
    end: Literal["strict", "truncate"] = "truncate" if question.end == "truncate" else "strict"
    values = monitor.requirement_robustness(trace, end=end, semantics=question.semantics)
    chosen = {judgement.name for judgement in result.verdict}
    data = {
        name: np.asarray(rows, dtype=np.float64).reshape(trace.traces, trace.samples)
        for name, rows in values.items()
        if name in chosen
    }
    units = {judged.name: written_unit(judged.unit) for judged in result.verdict}
    signature = Signature(tuple(Column(name, units[name]) for name in data))
    path.parent.mkdir(parents=True, exist_ok=True)
    meta = replace(trace.meta, spec_text="", spec_path="", judge_text="", judge_path="")
    save_trace(path, Trace(signature, trace.dt, data, trace.t0, meta=meta, name=str(path)))
