"""Output of `stlc check`: a table, and the place and reason of each violation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stlc.cli.check.outcome import Checked, VerdictRow
from stlc.cli.framework.output import table
from stlc.cli.framework.render import render_place
from stlc.compile.ir.support import columns
from stlc.compile.ir.traverse import margin_units
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.escape import operand, shell, visible
from stlc.monitor.explain.report import Cause
from stlc.monitor.judgement import Judgement, Part, Verdict, beside
from stlc.monitor.signals import gap_text

if TYPE_CHECKING:
    from stlc.monitor.facts.fact import Fact
    from stlc.monitor.judgement import Status


def result_text(result: Checked, rows: Sequence[VerdictRow], *, color: bool) -> str:
    """Text that `stlc check` prints for one judged trace: table, reasons of violations, and verdict.

    `rows` are the rows of the table, one per requirement.
    """
    trace, verdict = result.trace, result.verdict
    title = (
        f"{visible(result.source.name)} on {visible(trace.name)}    "
        f"{trace.traces} trace{'s' if trace.traces != 1 else ''} x {trace.samples} samples, dt {trace.dt:g} s"
    )
    reasons = []
    for judged in verdict:
        cause = result.causes.get(judged.name)
        if cause is not None:
            reasons.append(_violation(judged, cause, result, color).rstrip("\n"))
        elif judged.overall == "inconclusive" and verdict.in_scope:
            reasons.append(_inconclusive(judged, result))
    unexplained = sum(judged.overall == "violated" for judged in verdict) - len(result.causes)
    if unexplained > 0:
        reasons.append(f"{unexplained:,} more are violated; --require NAME says why.")
    ending, folder = [_summary(verdict)], Path(trace.name).parent
    if (folder / "run.json").is_file():
        ending.append(f"next: {shell(('stlc', 'report', str(folder)))}")
    gaps = (
        *(
            *[f"clock {visible(str(clock))}" for clock in result.trace.clocks if not clock.plain],
            *[f"`{visible(name)}` may be off by {error}" for name, error in result.uncertain.items()],
            *_gap_texts(result).values(),
        ),
        *map(fact_text, result.facts_on("")),
    )
    return text_of(title, rows, gaps, reasons, ending, several=verdict.traces > 1)


def fact_text(fact: Fact) -> str:
    """Line on a fact about a recording: the fact, and a way out."""
    return "; ".join([fact.text, *fact.advice])


def text_of(
    title: str,
    rows: Iterable[VerdictRow],
    gaps: Iterable[str],
    reasons: Iterable[str],
    ending: Iterable[str],
    *,
    several: bool = False,
) -> str:
    """Text of a result: table of requirements, unknown samples, reasons, and last lines.

    Args:
        title: first line.
        rows: results of the requirements.
        gaps: lines about unknown and uncertain samples, one line per signal.
        reasons: paragraphs on requirements that are not satisfied.
        ending: last lines.
        several: whether the file has several traces.
    """
    least = "robustness (min over traces)" if several else "robustness"
    cells = [
        (
            row.name,
            row.verdict,
            row.robustness,
            row.share,
            "; ".join(filter(None, (row.where, *row.remarks))),
        )
        for row in rows
    ]
    lines = [title, "", table(cells, header=("requirement", "verdict", least, "starts", "where"))]
    lines += [f"  {text}" for text in gaps]
    for reason in reasons:
        lines += ["", reason]
    return "\n".join([*lines, "", *ending])


def robustness_text(
    status: Status, low: float, high: float, least: float, unit: str, tolerance: float = TOLERANCE
) -> str:
    """Text of the robustness of a requirement, with its unit.

    If the verdict `status` is inconclusive, the text shows the bounds `low` and `high`. Otherwise it shows
    the least robustness, `least`, and the word "boundary" if only the tolerance of the verdict decides; the
    word alone if `least` is zero up to rounding.
    """
    if status == "inconclusive":
        return in_unit(f"[{signed(low)}, {signed(high)}]", unit)
    if abs(least) <= min(tolerance, TOLERANCE):
        return "boundary"
    value = in_unit(signed(least), unit)
    return f"{value} (boundary)" if -tolerance <= least < 0.0 else value


def in_unit(value: str, unit: str) -> str:
    """Text of a robustness value with its unit, such as `+1.500 m`; without a unit, only the value."""
    return f"{value} {visible(unit)}".rstrip()


def signed(value: float) -> str:
    """A robustness with three decimals, or in scientific notation if tiny or huge."""
    if math.isfinite(value) and (0 < abs(value) < 0.0005 or abs(value) >= 1e9):
        return f"{value:+.1e}"
    return f"{value:+.3f}"


def percent(share: float) -> str:
    """Text of a share in percent; `100 %` is shown only for exactly 1, and `0 %` only for exactly 0."""
    percent = 100 * share
    if 0 < percent < 0.1 or 99.9 < percent < 100:
        return "< 0.1 %" if percent < 1 else "> 99.9 %"
    return f"{percent:.1f} %" if percent % 1 else f"{percent:.0f} %"


def _where(judged: Judgement, result: Checked) -> str:
    trace, sample = judged.worst
    cause = result.causes.get(judged.name)
    words = [f"trace {trace}"] if result.verdict.traces > 1 else []
    if cause is not None:
        words.append(beside(cause.moment, cause.started if judged.instants > 1 else cause.moment))
    elif judged.instants > 1:
        words.append(f"from {result.verdict.subject.moment(sample)}")
    return ", ".join(words)


def rows_of(result: Checked, violated_at: Mapping[str, float]) -> tuple[VerdictRow, ...]:
    """The rows of the table, with a reason for each unsatisfied requirement.

    `violated_at` is the time of the first violation in seconds, by requirement, where it is known.
    """
    rows = []
    for judged in result.verdict:
        cause, status = result.causes.get(judged.name), judged.overall
        low, high = (float(judged.counted(end).min(initial=np.inf)) for end in judged.margins)
        robustness, least = "", 0.0
        unit = judged.unit or ("" if cause is None else cause.unit)
        several = margin_units(judged.rule.typed.formula)[:3]
        units = unit or ("|".join(each or "1" for each in several) if any(several) else "")
        if judged.counted(judged.least).size:
            least = low if status == "inconclusive" else float(judged.counted(judged.least).min())
            shown = "inconclusive" if result.uncertain else status
            robustness = robustness_text(shown, low, high, least, units, judged.tolerance)
        share = "" if judged.holds.size == 1 else percent(judged.share)
        why = _inconclusive(judged, result) if status == "inconclusive" else ""
        why, where = why if cause is None else cause.because, _where(judged, result)
        at = violated_at.get(judged.name)
        rows.append(
            VerdictRow(
                *(judged.name, status, robustness, share, where, why, least, unit, at),
                facts=result.facts_on(judged.name),
            )
        )
    return tuple(rows)


# ------------------------------------------------------------------------ reasons


def _violation(judged: Judgement, cause: Cause, result: Checked, color: bool) -> str:
    verdict = result.verdict
    start = f"{verdict.subject.time(cause.start):.10g}s"
    track = ("--group", result.trace.track) if result.trace.track else ()
    words = (*result.options, operand(result.trace.file), *track, "--require", judged.name, "--at", start)
    advice = [("because", cause.because), ("replay", shell(("stlc", "check", *words)))]
    headline = f"{visible(judged.name)} is violated"
    if verdict.traces > 1:
        headline += f" in {judged.statuses.count('violated')} of {verdict.in_scope} traces"
    if judged.instants > 1:
        fails = judged.counted(judged.fails)
        headline += f", at {int(fails.sum()):,} of {fails.size:,} starts"
    return f"{headline}.\n{render_place(cause.place, cause.labels, advice, color=color)}"


def _gap_texts(result: Checked) -> dict[str, str]:
    """Return a line of text for each signal with unknown samples that a requirement reads.

    The result maps the name of the signal to the line.
    """
    subject = result.verdict.subject
    samples = subject.signals.samples * subject.signals.batch
    moment = subject.moment
    return {
        name: gap_text(name, gap, samples, (moment(gap.first), moment(gap.last)))
        for name, gap in subject.gaps.items()
    }


def _inconclusive(judged: Judgement, result: Checked) -> str:
    name = visible(judged.name)
    part = judged.part or Part(0, result.trace.samples)
    last = judged.start - part.first + judged.instants - 1 + judged.rule.reach
    needed, length = last * result.trace.dt, (part.stop - part.first - 1) * result.trace.dt
    gaps = [text for signal, text in _gap_texts(result).items() if signal in columns(judged.rule.formula)]
    if gaps and needed <= length:
        return f"{name} is inconclusive: {', '.join(gaps)}."
    if needed > length:
        more = "".join(f", and {text}" for text in gaps)
        return (
            f"{name} is inconclusive: it needs {needed:.6g} s of signal, the trace has {length:.6g} s{more}."
        )
    if result.uncertain:
        return f"{name} is inconclusive: the errors of the signals decide it."
    cells = result.verdict.subject.record.cells
    if cells is not None:
        return (
            f"{name} is inconclusive: values between the instants of the grid leave it open.\n"
            "A shorter step (--resample), or --between SIGNAL=hold or =linear, may decide it."
        )
    return f"{name} is inconclusive: it has no value where it was judged."


def lint_text(result: Checked) -> str:
    """Line on what `stlc lint` would say of a specification; "" if nothing."""
    if not result.lint:
        return ""
    count = f"{len(result.lint)} warning{'s' if len(result.lint) > 1 else ''}"
    file = result.source.name
    command = f"; {shell(('stlc', 'lint', operand(file)))}" if Path(file).is_file() else ""
    return f"lint: {count}: {', '.join(sorted(set(result.lint)))}{command}"


def _summary(verdict: Verdict) -> str:
    traces, outside = verdict.in_scope, verdict.traces - verdict.in_scope
    if not traces:
        return "out of scope: the assumptions do not hold"
    count = max(judged.instants for judged in verdict) * traces
    starts = f"{percent(verdict.share)} of {count:,} starts"
    if verdict.traces > 1:
        text = f"{verdict.satisfied_traces} of {traces} traces satisfy every requirement; {starts}"
    elif count > 1:
        text = f"{verdict.overall}; all requirements hold at {starts}"
    else:
        text = verdict.overall
    return text + (f"; {outside} out of scope" if outside else "")
