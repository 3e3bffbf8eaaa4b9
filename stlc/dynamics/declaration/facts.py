"""What a system file declares, in short."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from stlc.compile.ir.discretize import Horizon
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.inputs import InputDecl
from stlc.dynamics.schema.names import ControlDecl
from stlc.jsontext import Num
from stlc.signature import Column

if TYPE_CHECKING:
    from stlc.dynamics.robots.crosscheck import Comparison


@dataclass(frozen=True, slots=True)
class StateFacts:
    """A state of a system: its column, and its flow as written; None if it does not flow."""

    JSON: ClassVar = "name=column.name kind role low=column.low high=column.high unit labels flow"

    column: Column
    flow: str | None

    @property
    def kind(self) -> str:
        """Type of the state."""
        return self.column.kind

    @property
    def role(self) -> str:
        """Role of the state."""
        return self.column.role

    @property
    def unit(self) -> str:
        """Unit of the stored numbers."""
        return str(self.column.unit)

    @property
    def labels(self) -> dict[str, Num]:
        """Members of an enum."""
        return dict(self.column.labels)


@dataclass(frozen=True, slots=True)
class ControlFacts:
    """A control of a system, and its range."""

    name: str
    low: Num
    high: Num
    unit: str

    @classmethod
    def of(cls, control: ControlDecl) -> ControlFacts:
        """Facts about a control."""
        return cls(control.name, control.low, control.high, str(control.unit))


@dataclass(frozen=True, slots=True)
class InputFacts:
    """An input signal of a system; see `stlc.dynamics.declaration.inputs.InputDecl`."""

    name: str
    low: Num
    high: Num
    pieces: int
    interpolate: Literal["hold", "linear", "pchip"]
    free_times: bool
    unit: str
    seconds: Num
    columns: tuple[str, ...]

    @classmethod
    def of(cls, each: InputDecl) -> InputFacts:
        """Facts about an input signal."""
        shape = (each.pieces, each.interpolate, each.free_times, str(each.unit), float(each.duration))
        return cls(each.name, each.low, each.high, *shape, tuple(each.columns))


@dataclass(frozen=True, slots=True)
class DrivenSteps:
    """Steps of random rollouts, and their seed."""

    steps: int
    seed: int


@dataclass(frozen=True, slots=True)
class SystemFacts:
    """The declarations of a system, and what trying it showed.

    Attributes:
        decl: the declarations.
        driven: random rollouts that were simulated; None if there were none.
        kinematics: comparisons of kinematics with another package; None if there were none.
    """

    JSON: ClassVar = (
        "name=decl.name doc=decl.doc path dt horizon states controls inputs constants jumps situations "
        "driven? kinematics?"
    )

    NAMES: ClassVar = {"Comparison": "stlc.dynamics.robots.crosscheck"}

    decl: SystemDecl
    driven: DrivenSteps | None = None
    kinematics: tuple[Comparison, ...] | None = None

    @property
    def path(self) -> str:
        """Path of the file."""
        return str(self.decl.path)

    @property
    def dt(self) -> Num:
        """Time step in seconds."""
        return float(self.decl.dt)

    @property
    def horizon(self) -> Horizon:
        """Length of a plan."""
        return Horizon(float(self.decl.dt * self.decl.horizon), self.decl.horizon)

    @property
    def states(self) -> list[StateFacts]:
        """The states."""
        flow = {assign.name: assign.text for assign in self.decl.flow}
        return [StateFacts(column, flow.get(column.name)) for column in self.decl.signature.columns]

    @property
    def controls(self) -> list[ControlFacts]:
        """The controls."""
        return list(map(ControlFacts.of, self.decl.controls))

    @property
    def inputs(self) -> list[InputFacts]:
        """The input signals."""
        return list(map(InputFacts.of, self.decl.inputs))

    @property
    def constants(self) -> dict[str, Num]:
        """The constants."""
        return {name: value for name, (value, _) in self.decl.constants.items()}

    @property
    def jumps(self) -> list[str]:
        """Names of the jumps."""
        return [jump.name for jump in self.decl.jumps]

    @property
    def situations(self) -> list[str]:
        """Names of the ways to draw initial states."""
        return [situation.name for situation in self.decl.init.mixture]


@dataclass(frozen=True, slots=True)
class ListedSystem:
    """A system that is found by name: its file, and its description, or why it is invalid."""

    name: str
    path: str
    doc: str


@dataclass(frozen=True, slots=True)
class SystemList:
    """The systems that are found by name."""

    systems: tuple[ListedSystem, ...]
