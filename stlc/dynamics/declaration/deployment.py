"""How a policy is deployed, as data: its backup, its world and what happens there, and scenarios."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.learning import Term
from stlc.dynamics.declaration.model import Assign
from stlc.runtime.prefixes import SAMPLES, Sampling
from stlc.source import Span


@dataclass(frozen=True, slots=True)
class BackupDecl:
    """What the backup policy tries.

    Attributes:
        bins: values of a control, evenly over its range.
        lengths: of prefixes, T0.
        batch: trajectories at a time.
        levels: name of a control -> its values, in the place of `bins`.
        samples: prefixes of one length at most.
        sampling: which, where there are more.
    """

    bins: int = 5
    lengths: tuple[int, ...] = (1, 2, 3)
    batch: int = 8192
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    samples: int = SAMPLES
    sampling: Sampling = "lattice"


@dataclass(frozen=True, slots=True)
class EventDecl:
    """Something that happens between steps and that the planner does not foresee.

    Attributes:
        name: for messages.
        when: a state formula; None where the event is timed.
        edge: fire only where `when` has just become true (`rise`) or false (`fall`).
        at: step at which it fires once.
        every: period in steps.
        sets: new values, in order; later ones read earlier ones.
    """

    name: str
    sets: tuple[Assign, ...]
    when: ir.Formula | None = None
    edge: Literal["rise", "fall"] | None = None
    at: int | None = None
    every: int | None = None


@dataclass(frozen=True, slots=True)
class WorldRef:
    """The class of a world, in a Python file beside the system file."""

    path: Path
    name: str
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class JudgeRef:
    """The specification that drives are judged by.

    Attributes:
        path: of its file.
        written: the path as the system file has it, by which a run knows its copy.
        span: where that stands.
    """

    path: Path
    written: str
    span: Span = field(compare=False, repr=False)


Starts = Literal["any", "savable", "feasible"]
"""Starts that agents may have: all that are drawn, or those from which a search finds a safe plan, or a
plan that satisfies everything."""


@dataclass(frozen=True, slots=True)
class TestDecl:
    """A deployment: how long, how many agents, how often they plan, and what happens to them.

    `uncertain`: the constants that `parameters` of a scenario's errors makes wrong; None: those that
    `stlc.dynamics.scenarios.uncertain` finds.
    `judge`: the specification that drives are judged by; None: the one that plans are made for.
    `starts`: which of the starts that are drawn are taken; the others are drawn again.
    """

    __test__ = False

    steps: int = 200
    agents: int = 20
    replan: int = 1
    events: tuple[EventDecl, ...] = ()
    metrics: tuple[str, ...] = ()
    world: WorldRef | None = None
    uncertain: tuple[str, ...] | None = None
    judge: JudgeRef | None = None
    starts: Starts = "any"


@dataclass(frozen=True, slots=True)
class ErrorsDecl:
    """How far actuators and sensors are off, as shares.

    Attributes:
        actuator_gain: of every control each agent gets so much more or less than it commands, all the time;
            a direction (squash `angle`) is off by this share of a radian instead.
        parameters: of every number in the dynamics (`stlc.dynamics.scenarios.uncertain`) the truth of each
            agent has so much more or less, all the time.
        actuator_noise: standard deviation of what is added to controls at every step, of half their range;
            to a direction, of a radian.
        sensor_noise: of what is added to the real states that agents see, of their nominal range; clocks,
            which are states in seconds, are known.
    """

    actuator_gain: float = 0.0
    parameters: float = 0.0
    actuator_noise: float = 0.0
    sensor_noise: float = 0.0


@dataclass(frozen=True, slots=True)
class ScenarioDecl:
    """A named overlay of a deployment.

    Attributes:
        name: as written.
        doc: one line for people.
        expect: "nominal", or "ood" where a policy meets what training never drew.
        constants: other values, as text; they change the model too.
        override: initial values, drawn after all others.
        events: that happen beside those of `test`.
        disturb: what is added to derivatives of the truth, not of the model.
        noise: what is added to the states that agents see.
        mismatch: constants of the truth that the model does not know, as text.
        world: in the place of that of `test`.
        errors: of actuators and sensors.
        prefer: performance terms that plans are chosen by, beside those of the objective.
        backup: in the place of the system's.
        judge: in the place of that of `test`.
    """

    name: str
    doc: str = ""
    expect: str = "nominal"
    constants: Mapping[str, str] = field(default_factory=dict)
    override: tuple[Assign, ...] = ()
    events: tuple[EventDecl, ...] = ()
    disturb: tuple[Assign, ...] = ()
    noise: tuple[Assign, ...] = ()
    mismatch: Mapping[str, str] = field(default_factory=dict)
    world: WorldRef | None = None
    errors: ErrorsDecl = field(default_factory=ErrorsDecl)
    prefer: tuple[Term, ...] = ()
    backup: BackupDecl | None = None
    judge: JudgeRef | None = None
