"""The document `check/1`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

from stlc.cli.checked import Checked
from stlc.monitor.explain import Cause
from stlc.monitor.judgement import Judgement


def document(results: Sequence[Checked], end: str) -> dict[str, Any]:
    """What `--json` says: the result of one trace; of several, one verdict and the list of them."""
    entries = [_entry(result, end) for result in results]
    if len(entries) == 1:
        return entries[0]
    found = {result.verdict.overall for result in results}
    overall = (
        "violated" if "violated" in found else "inconclusive" if "inconclusive" in found else "satisfied"
    )
    return {"verdict": overall, "files": entries}


def _entry(result: Checked, end: str) -> dict[str, Any]:
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
        "verdict": verdict.overall,
        "robustness": float(verdict.robustness.min()),
        "satisfied_traces": verdict.satisfied_traces,
        "satisfied_share": verdict.share,
        "requirements": [_requirement(judged, result) for judged in verdict],
    }


def _requirement(judged: Judgement, result: Checked) -> dict[str, Any]:
    low, high = judged.bounds
    least = judged.least
    trace, sample = judged.worst
    cause = result.causes.get(judged.name)
    time = result.verdict.subject.time(sample)
    return {
        "name": judged.name,
        "doc": judged.rule.doc,
        "tags": sorted(judged.rule.tags),
        "verdict": judged.overall,
        "robustness": {
            "min": float(least.min()),
            "mean": float(least.mean()),
            "low": float(low.min()),
            "high": float(high.min()),
            "argmin": {"trace": trace, "start": time, "time": time if cause is None else cause.time},
        },
        "starts": judged.instants,
        "satisfied_share": judged.share,
        "violated_traces": judged.statuses.count("violated"),
        "cause": None if cause is None else _cause(cause),
    }


def _cause(cause: Cause) -> dict[str, Any]:
    first = cause.readings[0] if cause.readings else None
    return {
        "signal": None if first is None else first.signal,
        "value": None if first is None else first.value,
        "predicate": cause.predicate,
        "readings": [{"signal": r.signal, "value": r.value, "text": r.text} for r in cause.readings],
        "trace": cause.trace,
        "start": cause.start,
        "sample": cause.sample,
        "time": cause.time,
        "span": {"line": cause.span.line, "column": cause.span.column},
        "requirement": {"line": cause.place.span.line, "column": cause.place.span.column},
        "because": cause.because,
    }
