"""Violations of a recording, each traced back through the sub-formulas to the values that decide it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from stlc.jsontext import Num
from stlc.monitor.explain.causes import CauseNode
from stlc.monitor.explain.report import Cause, readings_of
from stlc.monitor.judgement import Verdict

_WIDTH = 72


@dataclass(frozen=True, slots=True)
class Step:
    """A sub-formula in a tree of causes: its place, its truth value and robustness, and the values it reads.

    Attributes:
        depth: depth in the tree.
        text: its text.
        line: line in the source, from 1.
        column: column in the source, from 1.
        holds: its truth value.
        time: time at which it has it, in seconds.
        robustness: its robustness there.
        unit: unit of the robustness.
        readings: names and values of the signals that it reads.
        when: the instant in words, or the window in which the truth value is wrong.
    """

    JSON: ClassVar = "depth text line column holds time robustness unit readings"

    depth: int
    text: str
    line: int
    column: int
    holds: bool
    time: Num
    robustness: Num
    unit: str
    readings: tuple[str, ...]
    when: str

    @property
    def short(self) -> str:
        """The text, cut to a line."""
        return self.text if len(self.text) <= _WIDTH else f"{self.text[: _WIDTH - 1]}…"


@dataclass(frozen=True, slots=True)
class ExplainedViolation:
    """Violation of a requirement, with the tree of its causes, parents before their children."""

    JSON: ClassVar = "requirement=cause.name trace=cause.trace start violated because=cause.because tree"

    cause: Cause
    tree: tuple[Step, ...]

    @property
    def start(self) -> Num:
        """Time at which the requirement was evaluated, in seconds."""
        return self.cause.started_at

    @property
    def violated(self) -> Num:
        """Time at which the body of the outermost `always` is violated, in seconds."""
        return self.cause.timeline.time(self.cause.violated - self.cause.first)


@dataclass(frozen=True, slots=True)
class Explanation:
    """Violations of a recording, and their causes; `verdict` is what was judged."""

    JSON: ClassVar = "trace=verdict.about.trace verdict=verdict.overall causes"

    verdict: Verdict
    causes: tuple[ExplainedViolation, ...]

    def __repr__(self) -> str:
        causes = (f"{each.cause.name} because {each.cause.because}" for each in self.causes)
        return f"Explanation({'; '.join(causes) or self.closest})"

    @property
    def closest(self) -> str:
        """That nothing is violated, and the least robustness: whose it is and where."""
        worst = self.verdict.worst
        return f"nothing is violated ({self.verdict.scoped}); {worst.name} comes closest: {worst.brief}"


def explanation(verdict: Verdict) -> Explanation:
    """Explain every violation of a verdict that was not told."""
    found = (ExplainedViolation(cause, tuple(_steps(cause))) for cause in verdict.causes.values())
    return Explanation(verdict, tuple(found))


def _steps(cause: Cause) -> Iterator[Step]:
    """Yield the sub-formulas of a tree of causes, parents before their children.

    Of several children, the one that decides the value of the parent comes first. The function does not
    recurse. So a deeply nested formula cannot overflow the stack.
    """
    stack = [(0, cause.tree)]
    while stack:
        depth, node = stack.pop()
        yield _step(depth, node, cause)
        main = node.parts[node.main : node.main + 1]
        others = [part for i, part in enumerate(node.parts) if i != node.main]
        stack.extend((depth + 1, part) for part in reversed([*main, *others]))


def _step(depth: int, node: CauseNode, cause: Cause) -> Step:
    timeline, subject = cause.timeline, cause.subject
    when = f"at {timeline.moment(node.sample)}"
    if node.during is not None:
        first, last = (timeline.moment(k) for k in (node.during[0], node.during[-1]))
        when = f"from {first} to {last.removeprefix('t = ')}, closest {when}"
    readings = tuple(reading.text for reading in readings_of(node, subject, subject.record.samples))
    return Step(
        depth,
        " ".join(node.span.text.split()),
        node.span.line,
        node.span.column,
        node.holds,
        timeline.time(node.sample),
        node.rho,
        node.formula.margin_unit,
        readings,
        when,
    )
