"""Machine-readable results of `stlc check`: JSON, JUnit XML, and robustness as a trace."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from stlc.cli.check.outcome import Checked, Outcome, VerdictRow, overall
from stlc.escape import xml
from stlc.monitor.explain.report import Cause
from stlc.monitor.judgement import Judgement
from stlc.monitor.signals import Gap

if TYPE_CHECKING:
    from stlc.cli.check.judge import Question
    from stlc.cli.check.outcome import Checked


def document(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Document of `--json`: the result of one trace, or one verdict and the list of results."""
    entries = [outcome.entry for outcome in outcomes]
    return entries[0] if len(entries) == 1 else {"verdict": overall(outcomes), "files": entries}


def entry_of(result: Checked, end: str) -> dict[str, Any]:
    """The result of one trace as JSON values."""
    verdict = result.verdict
    horizon = verdict.subject.horizon
    return {
        "trace": result.trace.name,
        "spec": result.source.name,
        "spec_sha256": hashlib.sha256(result.source.text.encode()).hexdigest(),
        "dt": result.trace.dt,
        "horizon": None if horizon is None else {"seconds": horizon * result.trace.dt, "steps": horizon},
        "end": end,
        "traces": verdict.traces,
        "samples": result.trace.samples,
        "unknown": {name: gap_entry(gap, verdict.subject.time) for name, gap in verdict.subject.gaps.items()},
        "in_scope": verdict.in_scope,
        "verdict": verdict.overall if verdict.in_scope else "out of scope",
        "robustness": _least(verdict.requirements[0].counted(np.atleast_1d(verdict.robustness))),
        "satisfied_traces": verdict.satisfied_traces,
        "satisfied_share": verdict.share,
        "requirements": [_requirement(judged, result) for judged in verdict],
    }


def gap_entry(gap: Gap, time: Callable[[int], float]) -> dict[str, Any]:
    """Samples at which a signal is unknown."""
    return {"samples": gap.samples, "first": time(gap.first), "last": time(gap.last)}


def _requirement(judged: Judgement, result: Checked) -> dict[str, Any]:
    low, high, least = (judged.counted(end) for end in (*judged.margins, judged.least))
    trace, sample = judged.worst
    cause = result.causes.get(judged.name)
    time = result.verdict.subject.time(sample)
    return {
        "name": judged.name,
        "doc": judged.rule.doc,
        "tags": sorted(judged.rule.tags),
        "verdict": judged.overall,
        "robustness": {
            "min": _least(least),
            "mean": _mean(least),
            "low": _least(low),
            "high": _least(high),
            "unit": judged.unit or ("" if cause is None else cause.unit),
            "argmin": {"trace": trace, "start": time, "time": time if cause is None else cause.time},
        },
        "starts": judged.instants,
        "satisfied_share": judged.share,
        "violated_traces": judged.statuses.count("violated"),
        "cause": None if cause is None else cause_entry(cause),
    }


def _least(values: NDArray[np.float64]) -> float | None:
    return float(values.min()) if values.size else None


def _mean(values: NDArray[np.float64]) -> float | None:
    """The mean; values are divided first, as their sum may overflow."""
    with np.errstate(invalid="ignore"):  # +inf and -inf have no mean
        return float((values / values.size).sum()) if values.size else None


def cause_entry(cause: Cause) -> dict[str, Any]:
    """The cause of a violation as JSON values."""
    first = cause.readings[0] if cause.readings else None
    return {
        "signal": None if first is None else first.signal,
        "value": None if first is None else first.value,
        "predicate": cause.predicate,
        "readings": [
            {"signal": r.signal, "value": r.value, "unit": r.unit, "text": r.text} for r in cause.readings
        ],
        "trace": cause.trace,
        "start": cause.start,
        "sample": cause.sample,
        "time": cause.time,
        "span": {"line": cause.span.line, "column": cause.span.column},
        "requirement": {"line": cause.place.span.line, "column": cause.place.span.column},
        "because": cause.because,
    }


def junit(outcomes: Sequence[Outcome]) -> str:
    """The JUnit XML document."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f"<testsuites{_counts(outcomes)}>"]
    for outcome in outcomes:
        lines += _suite(outcome)
    return "\n".join([*lines, "</testsuites>", ""])


def _counts(outcomes: Sequence[Outcome]) -> str:
    rows = [row for outcome in outcomes for row in outcome.rows]
    errors = sum(bool(outcome.errors) for outcome in outcomes)
    failures = sum(row.status == "violated" for row in rows)
    skipped = sum(row.status in ("inconclusive", "out of scope") for row in rows)
    seconds = sum(outcome.seconds for outcome in outcomes)
    return (
        f' tests="{len(rows) + errors}" failures="{failures}" errors="{errors}" skipped="{skipped}"'
        f' time="{seconds:.3f}"'
    )


def _suite(outcome: Outcome) -> Iterator[str]:
    yield f"  <testsuite name={_attribute(outcome.name)}{_counts([outcome])}>"
    for error in outcome.errors[:1]:
        yield f'    <testcase classname={_attribute(outcome.name)} name="trace">'
        detail = xml("\n".join(f"{e.code}: {e.message}" for e in outcome.errors))
        told = f"type={_attribute(error.code)} message={_attribute(error.message)}"
        yield f"      <error {told}>{detail}</error>"
        yield "    </testcase>"
    for row in outcome.rows:
        yield from _case(outcome, row)
    yield "  </testsuite>"


def _case(outcome: Outcome, row: VerdictRow) -> Iterator[str]:
    head = f"    <testcase classname={_attribute(outcome.name)} name={_attribute(row.name)}"
    if row.status == "satisfied":
        yield f"{head}/>"
        return
    yield f"{head}>"
    if row.status == "violated":
        message = f"robustness {row.robustness}{', ' + row.where if row.where else ''}"
        yield f'      <failure type="violated" message={_attribute(message)}>{xml(row.why)}</failure>'
    else:
        yield f"      <skipped message={_attribute(row.why or row.status)}/>"
    yield "    </testcase>"


def _attribute(text: str) -> str:
    return f'"{xml(text)}"'


def write_robustness(path: Path, result: Checked, question: Question) -> None:
    """Write one signal per requirement, (traces, samples); NaN where it has no value.

    Raises:
        MissingError: R201, no room or no permission.
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
