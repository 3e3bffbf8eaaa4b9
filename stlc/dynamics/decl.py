"""What a system file says, as data: names bound, units checked, expressions in the IR. No torch."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Literal, TypeAlias

from stlc.compile import ir
from stlc.compile.interface import Grid, Interface
from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.dynamics.decl_errors import ErrorsDecl
from stlc.signature import Signature
from stlc.source import Source, Span
from stlc.units import Unit

Squash: TypeAlias = Literal["tanh", "clip", "angle"]

LEARNT = (
    *("dt", "horizon", "substeps", "integrator", "discrete", "constants", "signature", "controls"),
    *("flow", "jumps", "clamps", "init", "objective", "policy"),
)
"""The fields of a system that decide what a policy learns."""


@dataclass(frozen=True, slots=True)
class ControlDecl:
    """One control input.

    Attributes:
        name: as written.
        unit: of the numbers that are stored.
        low: lower end of its range, in `unit`.
        high: upper end.
        squash: how a network output becomes a value in the range.
        levels: the values that a search may try; empty where the range is sampled evenly.
    """

    name: str
    unit: Unit
    low: float
    high: float
    squash: Squash = "tanh"
    levels: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Assign:
    """A column (or a local name) and its new value, in the unit of that column."""

    name: str
    value: ir.Num
    text: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class JumpDecl:
    """Where the guard holds at the start of a step, the resets replace what would have flowed."""

    name: str
    guard: ir.Formula
    resets: tuple[Assign, ...]
    sharpness: float | None = None
    text: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class GridDecl:
    """Every combination of a few values: name of a column -> its values, in the unit of the column."""

    axes: tuple[tuple[str, tuple[float, ...]], ...]


@dataclass(frozen=True, slots=True)
class FileDecl:
    """States that lie in a file: each column an array of that name, all samples of all traces."""

    path: Path
    names: tuple[str, ...]
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Situation:
    """A way to draw an initial state: assignments in order, then one of the branches.

    Attributes:
        name: for messages and tables; "" for an unnamed branch.
        weight: share among its siblings, not normalised.
        draws: in order; later ones read earlier ones. Names that are no columns are local.
        branches: a sub-mixture that goes on from here.
        points: known states of which one is taken, before anything is drawn.
    """

    name: str
    weight: float
    draws: tuple[Assign, ...]
    branches: tuple[Situation, ...] = ()
    points: GridDecl | FileDecl | None = None


@dataclass(frozen=True, slots=True)
class InitDecl:
    """The distribution of initial states: a mixture, and conditions that every state must meet.

    Attributes:
        mixture: of situations.
        where: what every state must meet.
        where_text: as written.
        params: what is drawn before a situation is picked; situations may draw it anew.
        override: what is drawn last, over what situations say.
        span: for messages.
    """

    mixture: tuple[Situation, ...]
    where: tuple[ir.Formula, ...] = ()
    where_text: tuple[str, ...] = field(default=(), compare=False)
    params: tuple[Assign, ...] = ()
    override: tuple[Assign, ...] = ()
    span: Span | None = field(default=None, compare=False, repr=False)


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
class PolicyDecl:
    """Shape of the network and what it sees; no `observe` means every state.

    `mirror`: images of states and controls under a symmetry of system and specification; none where empty.
    """

    type: str = "mlp"
    hidden: tuple[int, ...] = (256, 256, 256)
    observe: tuple[ir.Num, ...] = ()
    observe_text: tuple[str, ...] = field(default=(), compare=False)
    mirror: tuple[Assign, ...] = ()
    mirror_span: Span | None = field(default=None, compare=False, repr=False)


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


@dataclass(frozen=True, slots=True)
class BackupDecl:
    """Prefixes of `lengths` with `bins` values a control, or the `levels` of its name; `batch` at a time."""

    bins: int = 5
    lengths: tuple[int, ...] = (1, 2, 3)
    batch: int = 8192
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)


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
class FunctionDecl:
    """A function that specifications may call: in Python, on arrays, or known as numbers.

    Attributes:
        name: by which `extern fn` knows it.
        module: the module, or the file beside the system file, that holds it.
        attribute: its name there.
        library: the arrays that it takes; None takes what the caller has.
        span: where it is named.
        body: what it computes, from one vector to one, where the file says that; None for Python.
    """

    name: str
    module: str | Path
    attribute: str
    library: Literal["numpy", "torch"] | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    body: ir.Body | None = field(default=None, repr=False)

    def bound(self, arguments: tuple[int | None, ...], result: int | None) -> ir.Body:
        """What it computes; see `stlc.compile.interface.Function`. Raises SystemFileError (S208)."""
        assert self.body is not None
        takes, gives = len(self.body.formals), len(self.body.outputs)
        if (arguments, result) == ((takes,), gives):
            return self.body
        form = f"extern fn {self.name}(q: real[{takes}]) -> real[{gives}]"
        message = (
            f"`{self.name}` takes a vector of {takes} and gives one of {gives}, declared is another form"
        )
        raise SystemFileError(Diagnostic("S208", message, self.span, "named here", help=(form,)))


@dataclass(frozen=True, slots=True)
class TestDecl:
    """A deployment: how long, how many agents, how often they plan, and what happens to them."""

    __test__ = False

    steps: int = 200
    agents: int = 20
    replan: int = 1
    events: tuple[EventDecl, ...] = ()
    metrics: tuple[str, ...] = ()
    world: WorldRef | None = None


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


@dataclass(frozen=True)
class SystemDecl:
    """A system file, validated.

    Attributes:
        name: as written.
        doc: one line for people.
        path: of the file.
        source: its text.
        spec: path of its default specification, or None.
        dt: seconds a step, exact.
        horizon: planning horizon in steps.
        substeps: integration steps within one step.
        integrator: name of the integrator.
        discrete: `flow` holds next-state maps instead of derivatives.
        constants: name -> (value in SI units, unit).
        signature: the state columns, in order.
        controls: the inputs, in order.
        flow: derivative (or next value) a column, in its unit per second; unlisted ones are constant.
        jumps: in file order.
        clamps: columns that are kept within (low, high).
        scenarios: named overlays.
        scenario: the one that is laid over, if any.
        functions: from outside, for specifications.
        bases: the texts of the files that it extends, the nearest first.
        overrides: what `--set` changed.
        places: name of a state, control, constant or definition -> where it is declared.
        warnings: findings that do not stop anything.
    """

    name: str
    doc: str
    path: Path
    source: Source = field(repr=False)
    spec: Path | None
    dt: Fraction
    horizon: int
    substeps: int
    integrator: str
    discrete: bool
    constants: Mapping[str, tuple[float, Unit]]
    signature: Signature
    controls: tuple[ControlDecl, ...]
    flow: tuple[Assign, ...]
    jumps: tuple[JumpDecl, ...]
    clamps: Mapping[str, tuple[float, float]]
    init: InitDecl
    objective: ObjectiveDecl
    policy: PolicyDecl
    train: TrainDecl
    backup: BackupDecl
    test: TestDecl
    scenarios: tuple[ScenarioDecl, ...] = ()
    scenario: ScenarioDecl | None = None
    functions: tuple[FunctionDecl, ...] = ()
    bases: tuple[Source, ...] = field(default=(), repr=False)
    overrides: Mapping[str, str] = field(default_factory=dict)
    places: Mapping[str, Span] = field(default_factory=dict, repr=False)
    warnings: tuple[Diagnostic, ...] = field(default=(), repr=False)

    @property
    def hash(self) -> str:
        """SHA-256 of the text and of what was overridden, in hexadecimal."""
        changes = "".join(f"\0{key}={value}" for key, value in sorted(self.overrides.items()))
        texts = "".join(base.text for base in self.bases)
        return hashlib.sha256((self.source.text + texts + changes).encode()).hexdigest()

    @property
    def learnt(self) -> str:
        """SHA-256 of what a policy learns from, in hexadecimal: all but names, comments, and deployment."""
        return hashlib.sha256(repr([getattr(self, name) for name in LEARNT]).encode()).hexdigest()

    @property
    def worlds(self) -> tuple[WorldRef, ...]:
        """Every world that the file names, for `test` and for scenarios."""
        named = (self.test.world, *(scenario.world for scenario in self.scenarios))
        return tuple(world for world in named if world is not None)

    @property
    def grid(self) -> Grid:
        """The steps that formulas are compiled for."""
        return Grid(self.dt, self.horizon)

    def interface(self) -> Interface:
        """What the compiler of specifications may know of this system, nothing loaded."""
        names = frozenset(function.name for function in self.functions)
        known = {function.name: function for function in self.functions if function.body is not None}
        path = self.source.name
        return Interface(
            self.name, self.signature, self.constants, names, known, path=path, places=self.places
        )
