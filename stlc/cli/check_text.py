"""What `stlc check` prints: a table, and for each violated requirement the place and the reason."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from stlc.cli.checked import Checked
from stlc.cli.output import table
from stlc.cli.render import render_place
from stlc.compile.semantics import TOLERANCE
from stlc.monitor.explain import Cause
from stlc.monitor.judgement import Judgement, Verdict

_WORDS = {"satisfied": "satisfied", "violated": "VIOLATED", "inconclusive": "inconclusive"}


def describe_result(result: Checked, *, color: bool) -> str:
    """Everything about one trace."""
    return "\n".join(_parts(result, color))


def _parts(result: Checked, color: bool) -> Iterator[str]:
    yield _title(result)
    yield ""
    yield _table(result)
    for judged in result.verdict:
        cause = result.causes.get(judged.name)
        if cause is not None:
            yield ""
            yield _violation(judged, cause, result, color).rstrip("\n")
        elif judged.overall == "inconclusive":
            yield ""
            yield _inconclusive(judged, result)
    yield ""
    yield _summary(result.verdict)
    folder = _run_of(result)
    if folder is not None:
        yield f"next: stlc report {folder}"


def _title(result: Checked) -> str:
    trace = result.trace
    count = f"{trace.traces} trace{'s' if trace.traces != 1 else ''} x {trace.samples} samples"
    return f"{result.source.name} on {trace.name}    {count}, dt {trace.dt:g} s"


def _table(result: Checked) -> str:
    several = result.verdict.traces > 1
    head = (
        "requirement",
        "verdict",
        f"robustness{' (min over traces)' if several else ''}",
        "starts",
        "where",
    )
    return table([_row(judged, result) for judged in result.verdict], header=head)


def _row(judged: Judgement, result: Checked) -> tuple[str, ...]:
    share = "" if judged.holds.size == 1 else _percent(judged.share)
    return (judged.name, _WORDS[judged.overall], _robustness(judged), share, _where(judged, result))


def _robustness(judged: Judgement) -> str:
    low, high = (float(end.min()) for end in judged.bounds)
    if judged.overall == "inconclusive":
        return f"[{_signed(low)}, {_signed(high)}]"
    value = float(judged.least.min())
    return "boundary" if abs(value) <= TOLERANCE else _signed(value)


def _signed(value: float) -> str:
    if math.isfinite(value) and 0 < abs(value) < 0.0005:
        return f"{value:+.1e}"
    return f"{value:+.3f}"


def _percent(share: float) -> str:
    """Rounded so that only all is 100 %, and only nothing 0 %."""
    percent = 100 * share
    if 0 < percent < 0.1 or 99.9 < percent < 100:
        return "< 0.1 %" if percent < 1 else "> 99.9 %"
    return f"{percent:.1f} %" if percent % 1 else f"{percent:.0f} %"


def _where(judged: Judgement, result: Checked) -> str:
    trace, sample = judged.worst
    cause = result.causes.get(judged.name)
    words = [f"trace {trace}"] if result.verdict.traces > 1 else []
    if cause is not None:
        words.append(result.verdict.subject.moment(cause.sample))
    elif judged.instants > 1:
        words.append(f"from {result.verdict.subject.moment(sample)}")
    return ", ".join(words)


# ------------------------------------------------------------------------ reasons


def _violation(judged: Judgement, cause: Cause, result: Checked, color: bool) -> str:
    verdict = result.verdict
    moment = verdict.subject.time(cause.start)
    replay = f"stlc check {result.trace.name} --require {judged.name} --at {moment:.10g}s"
    advice = [("because", cause.because), ("replay", replay)]
    return f"{_count(judged, verdict)}\n{render_place(cause.place, cause.labels, advice, color=color)}"


def _count(judged: Judgement, verdict: Verdict) -> str:
    headline = f"{judged.name} is violated"
    if verdict.traces > 1:
        headline += f" in {judged.statuses.count('violated')} of {verdict.traces} traces"
    if judged.instants > 1:
        headline += f", at {int(judged.fails.sum()):,} of {judged.fails.size:,} starts"
    return f"{headline}."


def _inconclusive(judged: Judgement, result: Checked) -> str:
    needed, length = result.needs(judged)
    if needed > length:
        return (
            f"{judged.name} is inconclusive: it needs {needed:.6g} s of signal, the trace has {length:.6g} s."
        )
    return f"{judged.name} is inconclusive: it has no value where it was judged."


def _summary(verdict: Verdict) -> str:
    count = max(judged.instants for judged in verdict) * verdict.traces
    starts = f"{_percent(verdict.share)} of {count:,} starts"
    if verdict.traces == 1:
        return f"{verdict.overall}; all requirements hold at {starts}" if count > 1 else verdict.overall
    return f"{verdict.satisfied_traces} of {verdict.traces} traces satisfy every requirement; {starts}"


def _run_of(result: Checked) -> str | None:
    """The run whose folder holds the trace."""
    folder = Path(result.trace.name).parent
    return str(folder) if (folder / "run.json").is_file() else None
