"""Facts that a system file declares, in short."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from stlc.compile.ir.discretize import Horizon
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.jsontext import Num
from stlc.signature import Column

if TYPE_CHECKING:
    from stlc.dynamics.crosscheck import Comparison


@dataclass(frozen=True, slots=True)
class StateFacts:
    """A state of a system: its column, and its flow as written; None if it does not flow."""

    JSON: ClassVar = (
        "name=column.name kind=column.kind role=column.role low=column.low high=column.high "
        "unit=column.unit.shown labels flow"
    )

    column: Column
    flow: str | None

    @property
    def labels(self) -> dict[str, Num]:
        """Members of an enum."""
        return dict(self.column.labels)


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
        "name=decl.name doc=decl.doc path=decl.path dt horizon states controls=decl.controls "
        "inputs=decl.inputs constants jumps situations driven? kinematics?"
    )
    NAMES: ClassVar = {"Comparison": "stlc.dynamics.crosscheck"}

    decl: SystemDecl
    driven: DrivenSteps | None = None
    kinematics: tuple[Comparison, ...] | None = None

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
