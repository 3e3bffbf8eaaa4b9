"""Facts: what is said of a requirement or a recording beside its verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from stlc.diagnostics import Diagnostic, Severity
from stlc.jsontext import Num


@dataclass(frozen=True, slots=True)
class Fact:
    """One fact about a requirement on a recording, or about the recording.

    Attributes:
        finding: its code, with a text that names no requirement, and its place in the specification.
        requirement: name of the requirement; "" if the fact is about the recording.
        signal: name of the signal; "" if it is about none.
        time: time in seconds of the sample that it is about; None if it is about none.
        count: number of instants, values or traces that the text counts; None if it counts none.
        of: number out of which `count` was counted.
        unjudged: whether the requirement was not fully judged, so that `--strict` counts the fact.
        beside: whether it stands beside the verdict, as in "satisfied, never triggered".
    """

    JSON: ClassVar = "code text signal time count of unjudged advice"

    finding: Diagnostic
    requirement: str = ""
    signal: str = ""
    time: Num | None = None
    count: int | None = None
    of: int | None = None
    unjudged: bool = False
    beside: bool = False

    @property
    def code(self) -> str:
        """Code of the fact, of which `stlc explain CODE` gives the rationale."""
        return self.finding.code

    @property
    def severity(self) -> Severity:
        """Severity: "fact" or "warning"."""
        return self.finding.severity

    @property
    def text(self) -> str:
        """The fact in words."""
        return self.finding.message

    @property
    def named(self) -> Diagnostic:
        """The finding with the name of the requirement in its text."""
        about = f"`{self.requirement}`: " if self.requirement else ""
        return replace(self.finding, message=f"{about}{self.text}")

    @property
    def advice(self) -> tuple[str, ...]:
        """Ways out, a line each."""
        return self.finding.help
