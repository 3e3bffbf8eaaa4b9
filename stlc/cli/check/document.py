"""The document `check/1`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.cli.check.checked import Checked
from stlc.cli.check.outcome import Outcome, overall
from stlc.monitor.explain.report import Cause
from stlc.monitor.judgement import Judgement
from stlc.monitor.signals import Gap


def document(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """What `--json` says: the result of one trace; of several, one verdict and the list of them."""
    entries = [outcome.entry for outcome in outcomes]
    return entries[0] if len(entries) == 1 else {"verdict": overall(outcomes), "files": entries}


def entry_of(result: Checked, end: str) -> dict[str, Any]:
    """Everything about one trace."""
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
    """Divided first: the sum of margins may be more than a float holds."""
    with np.errstate(invalid="ignore"):  # of +inf and -inf there is none
        return float((values / values.size).sum()) if values.size else None


def cause_entry(cause: Cause) -> dict[str, Any]:
    """Why a requirement is violated."""
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
