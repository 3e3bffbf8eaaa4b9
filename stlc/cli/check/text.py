"""Output of `stlc check`: a table, and the place and reason of each violation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stlc.cli.check.outcome import WORDS, Checked, VerdictRow
from stlc.cli.framework.output import table
from stlc.cli.framework.render import render_place
from stlc.compile.ir.support import columns
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.escape import operand, shell, visible
from stlc.monitor.explain.report import Cause
from stlc.monitor.judgement import Judgement, Verdict, beside
from stlc.monitor.signals import gap_text


def describe_result(result: Checked, *, color: bool) -> str:
    """The printed result of one trace."""
    return "\n".join(_parts(result, color))


def _parts(result: Checked, color: bool) -> Iterator[str]:
    yield _title(result)
    yield ""
    yield _table(result)
    yield from _gaps(result)
    for judged in result.verdict:
        cause = result.causes.get(judged.name)
        if cause is not None:
            yield ""
            yield _violation(judged, cause, result, color).rstrip("\n")
        elif judged.overall == "inconclusive" and result.verdict.in_scope:
            yield ""
            yield _inconclusive(judged, result)
    silent = sum(judged.overall == "violated" for judged in result.verdict) - len(result.causes)
    if silent > 0:
        yield ""
        yield f"{silent:,} more are violated; --require NAME says why."
    yield ""
    yield _summary(result.verdict)
    folder = _run_of(result)
    if folder is not None:
        yield f"next: {shell(('stlc', 'report', folder))}"


def _title(result: Checked) -> str:
    trace = result.trace
    count = f"{trace.traces} trace{'s' if trace.traces != 1 else ''} x {trace.samples} samples"
    return f"{visible(result.source.name)} on {visible(trace.name)}    {count}, dt {trace.dt:g} s"


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
    share = "" if judged.holds.size == 1 else percent(judged.share)
    return (judged.name, WORDS[judged.overall], _robustness(judged, result), share, _where(judged, result))


def _robustness(judged: Judgement, result: Checked) -> str:
    cause = result.causes.get(judged.name)
    unit = judged.unit or ("" if cause is None else cause.unit)
    low, high = (float(judged.counted(end).min(initial=np.inf)) for end in judged.margins)
    if not judged.counted(judged.holds).size:
        return ""
    if judged.overall == "inconclusive":
        return in_unit(f"[{signed(low)}, {signed(high)}]", unit)
    value = float(judged.counted(judged.least).min())
    return "boundary" if abs(value) <= TOLERANCE else in_unit(signed(value), unit)


def in_unit(value: str, unit: str) -> str:
    """A robustness with its unit, if any: `+1.500 m`."""
    return f"{value} {visible(unit)}".rstrip()


def signed(value: float) -> str:
    """A robustness with three decimals, or in scientific notation if tiny or huge."""
    if math.isfinite(value) and (0 < abs(value) < 0.0005 or abs(value) >= 1e9):
        return f"{value:+.1e}"
    return f"{value:+.3f}"


def percent(share: float) -> str:
    """A percentage; only 1 is shown as 100 %, and only 0 as 0 %."""
    percent = 100 * share
    if 0 < percent < 0.1 or 99.9 < percent < 100:
        return "< 0.1 %" if percent < 1 else "> 99.9 %"
    return f"{percent:.1f} %" if percent % 1 else f"{percent:.0f} %"


def _where(judged: Judgement, result: Checked) -> str:
    trace, sample = judged.worst
    cause = result.causes.get(judged.name)
    words = [f"trace {trace}"] if result.verdict.traces > 1 else []
    if cause is not None:
        moment = result.verdict.subject.moment
        start = cause.start if judged.instants > 1 else cause.sample
        words.append(beside(moment(cause.sample), moment(start)))
    elif judged.instants > 1:
        words.append(f"from {result.verdict.subject.moment(sample)}")
    return ", ".join(words)


def rows_of(result: Checked) -> tuple[VerdictRow, ...]:
    """The rows of the table, with a reason for each unsatisfied requirement."""
    return tuple(
        VerdictRow(
            judged.name,
            judged.overall,
            _robustness(judged, result),
            _where(judged, result),
            _why(judged, result),
        )
        for judged in result.verdict
    )


def _why(judged: Judgement, result: Checked) -> str:
    cause = result.causes.get(judged.name)
    if cause is not None:
        return cause.because
    return _inconclusive(judged, result) if judged.overall == "inconclusive" else ""


# ------------------------------------------------------------------------ reasons


def _violation(judged: Judgement, cause: Cause, result: Checked, color: bool) -> str:
    verdict = result.verdict
    moment = verdict.subject.time(cause.start)
    words = (*result.asked, operand(result.trace.name), "--require", judged.name, "--at", f"{moment:.10g}s")
    replay = shell(("stlc", "check", *words))
    advice = [("because", cause.because), ("replay", replay)]
    return f"{_count(judged, verdict)}\n{render_place(cause.place, cause.labels, advice, color=color)}"


def _count(judged: Judgement, verdict: Verdict) -> str:
    headline = f"{visible(judged.name)} is violated"
    if verdict.traces > 1:
        headline += f" in {judged.statuses.count('violated')} of {verdict.in_scope} traces"
    if judged.instants > 1:
        fails = judged.counted(judged.fails)
        headline += f", at {int(fails.sum()):,} of {fails.size:,} starts"
    return f"{headline}."


def _gaps(result: Checked) -> list[str]:
    """Needed but unknown samples, one line per signal."""
    return [f"  {text}" for text in _gap_texts(result).values()]


def _gap_texts(result: Checked) -> dict[str, str]:
    subject = result.verdict.subject
    samples = subject.signals.samples * subject.signals.batch
    moment = subject.moment
    return {
        name: gap_text(name, gap, samples, (moment(gap.first), moment(gap.last)))
        for name, gap in subject.gaps.items()
    }


def _inconclusive(judged: Judgement, result: Checked) -> str:
    name = visible(judged.name)
    needed, length = result.needs(judged)
    gaps = [text for signal, text in _gap_texts(result).items() if signal in columns(judged.rule.formula)]
    if gaps and needed <= length:
        return f"{name} is inconclusive: {', '.join(gaps)}."
    if needed > length:
        more = "".join(f", and {text}" for text in gaps)
        return (
            f"{name} is inconclusive: it needs {needed:.6g} s of signal, the trace has {length:.6g} s{more}."
        )
    return f"{name} is inconclusive: it has no value where it was judged."


def _summary(verdict: Verdict) -> str:
    outside = verdict.traces - verdict.in_scope
    if not verdict.in_scope:
        return "out of scope: the assumptions do not hold"
    if outside:
        return _summary_of(verdict, verdict.in_scope) + f"; {outside} out of scope"
    return _summary_of(verdict, verdict.traces)


def _summary_of(verdict: Verdict, traces: int) -> str:
    count = max(judged.instants for judged in verdict) * traces
    starts = f"{percent(verdict.share)} of {count:,} starts"
    if verdict.traces == 1:
        return f"{verdict.overall}; all requirements hold at {starts}" if count > 1 else verdict.overall
    return f"{verdict.satisfied_traces} of {traces} traces satisfy every requirement; {starts}"


def _run_of(result: Checked) -> str | None:
    """The run whose folder contains the trace, if any."""
    folder = Path(result.trace.name).parent
    return str(folder) if (folder / "run.json").is_file() else None
