"""What a policy is to learn and how, as data: the objective, the network, and the training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.model import Assign
from stlc.source import Span

START = "_start"
"""Behind the name of a state: its value at the start of the plan, in performance terms."""


@dataclass(frozen=True, slots=True)
class Term:
    """A performance term of the objective: `weight` times the mean of `value` over time and batch."""

    name: str
    weight: float
    value: ir.Num


@dataclass(frozen=True, slots=True)
class ObjectiveDecl:
    """The paper's loss (Eq. 8-10): hinge at `gamma` on the robustness of scale `smoothing`, plus `terms`."""

    gamma: float = 0.5
    smoothing: float = 500.0
    stl_weight: float = 1.0
    terms: tuple[Term, ...] = ()


@dataclass(frozen=True, slots=True)
class FeedbackDecl:
    """What `policy: {feedback: …}` asks for; `stlc.dynamics.model.feedback` makes it a gain.

    Attributes:
        around: name of a state or control -> its value at the point of operation, in its unit.
        weights: name of a state or control -> weight of its cost for the regulator.
        gain: control -> state -> entry of the gain, in the units of both; empty: that of the regulator.
        authority: how much the feedback adds at most, as a share of half the range of each actuator.
    """

    around: Mapping[str, float] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)
    gain: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    authority: float = 1.0


@dataclass(frozen=True, slots=True)
class PolicyDecl:
    """Shape of the network and what it sees; no `observe` means every state.

    `mirror`: images of states and controls under a symmetry of system and specification; none where empty.
    `feedback`: what lies beneath its plans, as asked for; None where plans are the controls themselves.
    """

    type: str = "mlp"
    hidden: tuple[int, ...] = (256, 256, 256)
    observe: tuple[ir.Num, ...] = ()
    observe_text: tuple[str, ...] = field(default=(), compare=False)
    mirror: tuple[Assign, ...] = ()
    mirror_span: Span | None = field(default=None, compare=False, repr=False)
    feedback: FeedbackDecl | None = None
    feedback_span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class TrainDecl:
    """Training defaults of this system; None leaves the choice to the engine.

    Attributes:
        budget: seconds.
        steps: of the optimiser; wins over `budget`.
        seed: of everything random in training.
        lr: learning rate.
        batch: fresh states a step.
        samples: size of a fixed training set (`method: gradient`).
        method: name of the training method.
    """

    budget: float | None = None
    steps: int | None = None
    seed: int = 0
    lr: float | None = None
    batch: int | None = None
    samples: int | None = None
    method: str | None = None
