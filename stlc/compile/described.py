"""The compiled form of a specification in short: added states, and requirements with intervals in steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from stlc.compile.ir.discretize import Horizon
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.jsontext import Num
from stlc.provenance import sha256


@dataclass(frozen=True, slots=True)
class AddedState:
    """A state that a specification adds to its system."""

    name: str
    kind: str
    initial: Num | None
    range: tuple[Num | None, Num | None]
    about: str


@dataclass(frozen=True, slots=True)
class WrittenInterval:
    """The interval of a temporal operator in steps and in seconds; None: to the end of the trace."""

    operator: str
    steps: tuple[int, int | None]
    seconds: tuple[Num, Num | None]
    written: str
    line: int | None


@dataclass(frozen=True, slots=True)
class RequirementInSteps:
    """A compiled requirement."""

    name: str
    doc: str
    tags: tuple[str, ...]
    weight: Num
    scale: Num
    reach: Horizon
    intervals: tuple[WrittenInterval, ...]

    @classmethod
    def of(cls, rule: CompiledRequirement, dt: float) -> RequirementInSteps:
        """A requirement on a grid with the time step `dt` in seconds."""
        reach, tags = Horizon(rule.reach * dt, rule.reach), tuple(sorted(rule.tags))
        intervals = []
        for node in rule.formula.windows():
            low, high = node.window.lo, node.window.hi
            seconds = (low * dt, None if high is None else high * dt)
            written, line = (node.span.text, node.span.line) if node.span else ("", None)
            intervals.append(WrittenInterval(node.op, (low, high), seconds, written, line))
        return cls(rule.name, rule.doc, tags, rule.weight, rule.scale, reach, tuple(intervals))


@dataclass(frozen=True, slots=True)
class CompiledSpec:
    """A specification compiled for a system."""

    spec: str
    spec_sha256: str
    system: str
    dt: Num
    horizon: Horizon
    states: tuple[str, ...]
    added: tuple[AddedState, ...]
    safety: tuple[str, ...]
    requirements: tuple[RequirementInSteps, ...]

    @classmethod
    def of(cls, compiled: Compiled, system: str, states: Sequence[str]) -> CompiledSpec:
        """A compiled specification; `system` is the path of its system, and `states` are its states."""
        dt, steps, source = float(compiled.grid.dt or 0), compiled.grid.horizon or 0, compiled.spec.source
        drawn = "drawn for every trajectory"
        added = [
            AddedState(each.name, "param", None, (each.low, each.high), f"{text}, {drawn}")
            for each, text in ((each.column, each.text) for each in compiled.parameters)
        ]
        added += [
            AddedState(timer.name, timer.kind, timer.initial, (timer.low, timer.high), timer.about)
            for timer in compiled.timers
        ]
        horizon = Horizon(float((compiled.grid.dt or 0) * steps), steps)
        return cls(
            *(source.name, sha256(source.text), system, dt, horizon),
            (*states, *(state.name for state in added)),
            tuple(added),
            tuple(rule.name for rule in compiled.safety),
            tuple(RequirementInSteps.of(rule, dt) for rule in compiled.requirements),
        )
