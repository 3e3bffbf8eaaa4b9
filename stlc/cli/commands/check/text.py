"""Terminal rendering of a verdict: a table, and the place and reason of each violation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.framework.output import table
from stlc.cli.framework.render import Paint, render_place
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.escape import operand, shell, visible

if TYPE_CHECKING:
    from stlc.compile.semantics.tolerance import Status
    from stlc.monitor.explain.report import Cause
    from stlc.monitor.facts.fact import Fact
    from stlc.monitor.judgement import RequirementVerdict, Verdict

WORDS: dict[Status, str] = {
    "satisfied": "satisfied",
    "violated": "VIOLATED",
    "inconclusive": "inconclusive",
    "out of scope": "out of scope",
}


def verdict_text(verdict: Verdict, replay: Sequence[str], *, color: bool) -> str:
    """Text that `stlc check` prints for one judged file: table, reasons of violations, and verdict.

    `replay` are the words of a command line that reads the same trace, to explain one of its violations.
    """
    about, several = verdict.about, verdict.traces > 1
    yes = "s" if verdict.traces != 1 else ""
    size = f"{verdict.traces} trace{yes} x {about.samples} samples, dt {about.dt or 0.0:g} s"
    title = f"{visible(about.source.name)} on {visible(about.trace)}    {size}"
    least = "robustness (min over traces)" if several else "robustness"
    cells = []
    for row in verdict:
        share = "" if row.holds.size == 1 and row.instants == 1 else percent(row.share)
        where = "; ".join(filter(None, (row.where, *remarks_of(row))))
        cells.append((row.name, words_of(row), robustness_of(row, verdict), share, where))
    rows = table(cells, header=("requirement", "verdict", least, "starts", "where")).split("\n")
    red = Paint(color)("error", WORDS["violated"])
    body = (
        line.replace(WORDS["violated"], red, 1) if row.overall == "violated" else line
        for row, line in zip(verdict, rows[1:], strict=True)
    )
    lines = [title, "", rows[0], *body]
    lines += [f"  clock {visible(str(clock))}" for clock in about.clocks if not clock.plain]
    lines += [f"  `{visible(name)}` may be off by {error}" for name, error in verdict.uncertain.items()]
    lines += [f"  {text}" for text in (*_gap_texts(verdict).values(), *map(fact_text, verdict.remarks))]
    for row in verdict:
        if (cause := row.cause) is not None:
            lines += ["", _violation(row, cause, verdict, replay, color=color).rstrip("\n")]
        elif row.overall == "inconclusive" and verdict.in_scope:
            lines += ["", inconclusive(row, verdict)]
    unexplained = len(verdict.violated) - len(verdict.causes)
    if unexplained > 0 and not verdict.streamed:
        lines += ["", f"{unexplained:,} more are violated; --require NAME says why."]
    lines += ["", _summary(verdict)]
    folder = Path(about.trace).parent
    if (folder / "run.json").is_file():
        lines.append(f"next: {shell(('stlc', 'report', str(folder)))}")
    return "\n".join(lines)


def words_of(row: RequirementVerdict) -> str:
    """The verdict with the facts that stand beside it: `satisfied, never triggered (0 of 5)`."""
    return ", ".join([WORDS[row.overall], *(fact.text for fact in row.facts if fact.beside)])


def remarks_of(row: RequirementVerdict) -> list[str]:
    """The facts about a requirement that do not stand beside its verdict."""
    return [fact.text for fact in row.facts if not fact.beside]


def fact_text(fact: Fact) -> str:
    """Line on a fact about a recording: the fact, and a way out."""
    return "; ".join([fact.text, *fact.advice])


def robustness_of(row: RequirementVerdict, verdict: Verdict | None) -> str:
    """Least robustness of a requirement, with its unit; bounds, if it is inconclusive; "" without a trace.

    It has no unit where the requirement compares quantities of different units.
    """
    found = row.figures
    if found.low is None or found.high is None or found.min is None:
        return ""
    shown: Status = "inconclusive" if verdict is not None and verdict.uncertain else row.overall
    return robustness_text(shown, found.low, found.high, found.min, found.unit, row.tolerance)


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
    return f"{value} (boundary)" if least < 0.0 and TOLERANCE.satisfied(least, tolerance) else value


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


# ------------------------------------------------------------------------ reasons


def _violation(
    row: RequirementVerdict, cause: Cause, verdict: Verdict, replay: Sequence[str], *, color: bool
) -> str:
    about, advice = verdict.about, [("because", cause.because)]
    if about.file:
        start = f"{row.timeline.time(cause.start):.10g}s"
        track = ("--group", about.track) if about.track else ()
        words = (*replay, operand(about.file), *track, "--require", row.name, "--at", start)
        advice.append(("replay", shell(("stlc", "check", *words))))
    headline = f"{visible(row.name)} is violated"
    if verdict.traces > 1:
        headline += f" in {row.violated_traces} of {verdict.in_scope} traces"
    if row.instants > 1:
        failed = row.counted(row.failed)
        headline += f", at {int(failed.sum()):,} of {row.instants * failed.size:,} starts"
    return f"{headline}.\n{render_place(cause.place, cause.labels, advice, color=color)}"


def _gap_texts(verdict: Verdict) -> dict[str, str]:
    """Return a line of text for each signal with unknown samples that a requirement reads.

    The result maps the name of the signal to the line.
    """
    from stlc.monitor.signals import gap_text

    samples, moment = verdict.about.samples * verdict.traces, verdict.requirements[0].timeline.moment
    return {
        name: gap_text(name, gap, samples, (moment(gap.first), moment(gap.last)))
        for name, gap in verdict.gaps.items()
    }


def inconclusive(row: RequirementVerdict, verdict: Verdict | None) -> str:
    """Sentence on why a requirement is inconclusive."""
    assert verdict is not None
    name, part, dt = visible(row.name), row.part, verdict.about.dt or 0.0
    last = row.start - part.first + row.instants - 1 + row.rule.reach
    needed, length = last * dt, (part.stop - part.first - 1) * dt
    time, read = row.timeline.time, row.parts_read or (row.timeline.duration,)
    gaps = [
        text
        for (signal, text), gap in zip(_gap_texts(verdict).items(), verdict.gaps.values(), strict=True)
        if signal in row.rule.formula.columns
        and any(time(gap.first) <= each.last and each.first <= time(gap.last) for each in read)
    ]
    if gaps and needed <= length:
        return f"{name} is inconclusive: {', '.join(gaps)}."
    if needed > length:
        more = "".join(f", and {text}" for text in gaps)
        return (
            f"{name} is inconclusive: it needs {needed:.6g} s of signal, the trace has {length:.6g} s{more}."
        )
    if verdict.uncertain:
        return f"{name} is inconclusive: the errors of the signals decide it."
    if verdict.about.resampled:
        return (
            f"{name} is inconclusive: values between the instants of the grid leave it open.\n"
            "A shorter step (--resample), or --between SIGNAL=hold or =linear, may decide it."
        )
    return f"{name} is inconclusive: it has no value where it was judged."


def lint_text(verdict: Verdict) -> str:
    """Line on what `stlc lint` would say of a specification; "" if nothing."""
    if not verdict.lint:
        return ""
    count = f"{len(verdict.lint)} warning{'s' if len(verdict.lint) > 1 else ''}"
    file = verdict.about.source.name
    command = f"; {shell(('stlc', 'lint', operand(file)))}" if Path(file).is_file() else ""
    return f"lint: {count}: {', '.join(verdict.lint_codes)}{command}"


def _summary(verdict: Verdict) -> str:
    traces, outside = verdict.in_scope, verdict.traces - verdict.in_scope
    if not traces:
        return "out of scope" if verdict.streamed else "out of scope: the assumptions do not hold"
    count = max(row.instants for row in verdict) * traces
    starts = f"{percent(verdict.share)} of {count:,} starts"
    if verdict.traces > 1:
        text = f"{verdict.satisfied_traces} of {traces} traces satisfy every requirement; {starts}"
    elif count > 1 and not verdict.streamed:
        text = f"{verdict.overall}; all requirements hold at {starts}"
    else:
        text = verdict.overall
    return text + (f"; {outside} out of scope" if outside else "")
