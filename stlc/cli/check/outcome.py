"""Results of `stlc check`: judged traces, their rows and texts, and the exit code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from stlc.diagnostics import Diagnostic
from stlc.monitor.explain.report import Cause
from stlc.monitor.judgement import Judgement, Verdict
from stlc.source import Source
from stlc.trace import Trace

if TYPE_CHECKING:
    from stlc.monitor.judgement import Status

WORDS: dict[Status, str] = {
    "satisfied": "satisfied",
    "violated": "VIOLATED",
    "inconclusive": "inconclusive",
    "out of scope": "out of scope",
}

SATISFIED, VIOLATED, INVALID, INCONCLUSIVE = 0, 1, 3, 4
EXIT_CODES: dict[Status, int] = {
    "satisfied": SATISFIED,
    "violated": VIOLATED,
    "inconclusive": INCONCLUSIVE,
}


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """One requirement on all traces of a file.

    Attributes:
        name: of the requirement.
        status: its verdict.
        robustness: the least one, as text.
        where: trace and time of the least robustness, as text.
        why: one line for a requirement that is not satisfied.
    """

    name: str
    status: Status
    robustness: str = ""
    where: str = ""
    why: str = ""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one file, judged or not.

    Attributes:
        name: of the file.
        status: over all traces and requirements.
        rows: one for each requirement.
        text: printed form of everything.
        entry: the same for a JSON document.
        traces: number of traces in scope.
        holds: share of the starts at which all requirements hold.
        fails: share of the starts at which one is violated.
        seconds: run time.
        warnings: of the compiler.
        said: further remarks.
        errors: reasons for which the file could not be judged.
        exit_code: that of the errors.
    """

    name: str
    status: Status = "inconclusive"
    rows: tuple[VerdictRow, ...] = ()
    text: str = ""
    entry: dict[str, Any] = field(default_factory=dict)
    traces: int = 0
    holds: float = 0.0
    fails: float = 0.0
    seconds: float = 0.0
    warnings: tuple[Diagnostic, ...] = ()
    said: tuple[str, ...] = ()
    errors: tuple[Diagnostic, ...] = ()
    exit_code: int = 0


def exit_code(outcomes: Sequence[Outcome], fail_under: float | None = None) -> int:
    """0 satisfied, 1 violated, 4 inconclusive; with `fail_under` the share of satisfied starts decides.

    A file that cannot be judged takes precedence over every verdict. Traces out of scope do not count.
    """
    broken = [outcome.exit_code for outcome in outcomes if outcome.errors]
    if broken:
        return max(broken)
    if fail_under is not None:
        return _by_share(outcomes, fail_under)
    return EXIT_CODES.get(overall(outcomes), INCONCLUSIVE)


def overall(outcomes: Sequence[Outcome]) -> Status:
    """Status over all files in scope."""
    found = {outcome.status for outcome in outcomes if not outcome.errors}
    if "violated" in found:
        return "violated"
    return "satisfied" if found - {"out of scope"} == {"satisfied"} else "inconclusive"


def _by_share(outcomes: Sequence[Outcome], least: float) -> int:
    traces = sum(outcome.traces for outcome in outcomes)
    if not traces:
        return INCONCLUSIVE
    holds = sum(outcome.holds * outcome.traces for outcome in outcomes) / traces
    fails = sum(outcome.fails * outcome.traces for outcome in outcomes) / traces
    if holds >= least:
        return SATISFIED
    return VIOLATED if 1.0 - fails < least else INCONCLUSIVE


@dataclass(frozen=True, slots=True)
class Checked:
    """A judged trace: its specification, verdict and causes.

    Attributes:
        trace: as read, signals renamed.
        source: text of the specification.
        verdict: per requirement.
        causes: violated requirement -> causes.
        asked: the command-line options of reading and judging.
    """

    trace: Trace
    source: Source
    verdict: Verdict
    causes: Mapping[str, Cause]
    asked: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """Of the compiler."""
        return self.verdict.subject.compiled.warnings

    def needs(self, judged: Judgement) -> tuple[float, float]:
        """Seconds of signal that the judged instants of a requirement need, and available seconds."""
        last = judged.start + judged.instants - 1 + judged.rule.reach
        return last * self.trace.dt, (self.trace.samples - 1) * self.trace.dt
