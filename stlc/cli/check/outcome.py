"""Results of `stlc check`: judged traces, their rows and texts, and the exit code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from stlc.cli.framework.documents import CheckedTrace, InvalidTrace
from stlc.diagnostics import Diagnostic
from stlc.source import Source

if TYPE_CHECKING:
    from stlc.assurance.certificate import Sample
    from stlc.monitor.explain.report import Cause
    from stlc.monitor.facts.fact import Fact
    from stlc.monitor.judgement import Status, Verdict
    from stlc.monitor.uncertain import Uncertainty
    from stlc.trace import Trace

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
    """Result of one requirement on all traces of a file, a row of the printed table.

    Attributes:
        name: name of the requirement.
        status: verdict.
        robustness: least robustness, as printed; "" if there is none.
        share: percentage of the judged instants at which the requirement holds, as printed; "" if it is
            judged at only one instant.
        where: trace and time of the least robustness.
        why: reason in one line, if the requirement is not satisfied.
        least: least robustness as a number, or its lower bound if inconclusive; 0 if there is none.
        unit: unit of the robustness.
        violated_at: time in seconds from which the requirement is certainly violated, whatever follows; None
            if it is not violated, or if the time was not looked for.
        facts: facts about the requirement, such as the part of the recording that it read.
    """

    name: str
    status: Status
    robustness: str
    share: str
    where: str
    why: str = ""
    least: float = 0.0
    unit: str = ""
    violated_at: float | None = None
    facts: tuple[Fact, ...] = ()

    @property
    def verdict(self) -> str:
        """The verdict with the facts that stand beside it: `satisfied, never triggered (0 of 5)`."""
        return ", ".join([WORDS[self.status], *(fact.text for fact in self.facts if fact.beside)])

    @property
    def remarks(self) -> list[str]:
        """The facts that do not stand beside the verdict, in words."""
        return [fact.text for fact in self.facts if not fact.beside]

    @property
    def unjudged(self) -> bool:
        """True if the requirement is satisfied, but was not fully judged."""
        return self.status == "satisfied" and any(fact.unjudged for fact in self.facts)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one trace file; it contains errors if the file could not be judged.

    Attributes:
        name: name of the file, and of the object in it.
        entry: JSON record of the result.
        status: verdict over all traces and requirements.
        rows: results of the requirements.
        text: printed result.
        traces: number of traces to which the specification applies.
        holds: share of the judged instants at which all requirements hold.
        fails: share of the judged instants at which at least one requirement is violated.
        seconds: time it took to judge the file.
        warnings: warnings of the compiler.
        remarks: further messages for the user.
        errors: reasons for which the file could not be judged.
        exit_code: exit code of the command for these errors; 0 without errors.
        sample: its traces as observations, with `--certify`; None if no trace is in scope.
        track: the object in the file, such as `agent=2`; "" if the file holds one.
        facts: facts about the recording.
        lint: what `stlc lint` would say of the specification, in one line; "" if nothing.
    """

    name: str
    entry: CheckedTrace | InvalidTrace
    status: Status = "inconclusive"
    rows: tuple[VerdictRow, ...] = ()
    text: str = ""
    traces: int = 0
    holds: float = 0.0
    fails: float = 0.0
    seconds: float = 0.0
    warnings: tuple[Diagnostic, ...] = ()
    remarks: tuple[str, ...] = ()
    errors: tuple[Diagnostic, ...] = ()
    exit_code: int = 0
    sample: Sample | None = None
    track: str = ""
    facts: tuple[Fact, ...] = ()
    lint: str = ""

    @property
    def file(self) -> str:
        """Name of the file."""
        return self.name.removesuffix(f" ({self.track})")


def exit_code(outcomes: Sequence[Outcome], fail_under: float | None = None, *, strict: bool = False) -> int:
    """Return the exit code: 0 satisfied, 1 violated, 4 inconclusive; other codes if a file cannot be judged.

    With `fail_under`, the code depends on the share of the judged instants at which all requirements hold.
    The code is 0 if this share is at least `fail_under`. It is 1 if the share stays below `fail_under`
    whatever samples follow. It is 4 if this is undecided. With `strict`, it is 4 instead of 0 if a satisfied
    requirement was not fully judged. If a file cannot be judged, its exit code is
    returned, whatever the verdicts of the other files. Traces to which the specification does not apply (out
    of scope) do not count.
    """
    broken = [outcome.exit_code for outcome in outcomes if outcome.errors]
    if broken:
        return max(broken)
    code = _verdict_code(outcomes, fail_under)
    unjudged = any(row.unjudged for outcome in outcomes for row in outcome.rows)
    return INCONCLUSIVE if strict and unjudged and code == SATISFIED else code


def _verdict_code(outcomes: Sequence[Outcome], fail_under: float | None) -> int:
    traces = sum(outcome.traces for outcome in outcomes)
    if fail_under is not None and traces:
        holds = sum(outcome.holds * outcome.traces for outcome in outcomes) / traces
        fails = sum(outcome.fails * outcome.traces for outcome in outcomes) / traces
        return SATISFIED if holds >= fail_under else VIOLATED if 1.0 - fails < fail_under else INCONCLUSIVE
    if fail_under is not None:
        return INCONCLUSIVE
    return EXIT_CODES.get(overall(outcomes), INCONCLUSIVE)


def overall(outcomes: Sequence[Outcome]) -> Status:
    """Return the verdict over all judged files.

    Files to which the specification does not apply do not count.
    """
    found = {outcome.status for outcome in outcomes if not outcome.errors}
    if "violated" in found:
        return "violated"
    return "satisfied" if found - {"out of scope"} == {"satisfied"} else "inconclusive"


@dataclass(frozen=True, slots=True)
class Checked:
    """A judged trace with its specification, its verdict and the causes of violations.

    Attributes:
        trace: trace as read, signals renamed.
        source: text of the specification.
        verdict: verdict per requirement.
        causes: name of a violated requirement -> cause of the violation.
        options: command-line options of reading and judging.
        remarks: messages for the user.
        uncertain: signal -> greatest error of its samples.
        facts: facts about the requirements and about the recording.
        lint: codes of the warnings that `stlc lint` has of the specification, besides the compiler's.
    """

    trace: Trace
    source: Source
    verdict: Verdict
    causes: Mapping[str, Cause]
    options: tuple[str, ...]
    remarks: tuple[str, ...]
    uncertain: Mapping[str, Uncertainty] = field(default_factory=dict)
    facts: tuple[Fact, ...] = ()
    lint: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """Warnings of the compiler, and about the file."""
        doubts = (fact.finding for fact in self.facts if fact.severity == "warning")
        return (*self.trace.remarks, *self.verdict.subject.compiled.warnings, *doubts)

    def facts_on(self, requirement: str) -> tuple[Fact, ...]:
        """Facts about a requirement, without places; "" selects those about the recording.

        Warnings are left out.
        """
        chosen = (f for f in self.facts if f.requirement == requirement and f.severity == "fact")
        return tuple(replace(fact, finding=replace(fact.finding, span=None)) for fact in chosen)
