"""Results of searches for violations, and of their repetition; files of counterexamples."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from stlc.assurance.falsify import Counterexample, Falsification
from stlc.jsontext import Num
from stlc.plants.plant import PlantFinding
from stlc.registry import GUARDS


@dataclass(frozen=True, slots=True)
class FalsifiedRequirement:
    """Search for a violation of one requirement.

    Attributes:
        search: the search.
        file: file of the counterexample; None without one.
        replay: command that simulates it again; None without one.
        trace_margin: robustness of its trace; None without one.
    """

    JSON: ClassVar = (
        "name=search.requirement verdict simulations=search.simulations inconclusive=search.inconclusive "
        "least=search.least found=search.found simpler=search.shrunk spurious=search.spurious "
        "coverage=search.coverage rejected=search.rejected seconds=search.seconds "
        "strategies=search.strategies file replay trace_margin"
    )

    search: Falsification
    file: str | None = None
    replay: str | None = None
    trace_margin: Num | None = None

    @property
    def verdict(self) -> Literal["violated", "open", "inconclusive"]:
        """Violated if there is a counterexample; inconclusive if no simulation has a verdict."""
        if self.counterexample is not None:
            return "violated"
        return "open" if self.search.simulations > self.search.inconclusive else "inconclusive"

    @property
    def counterexample(self) -> Counterexample | None:
        """The simplest counterexample."""
        return self.search.shrunk or self.search.found


@dataclass(frozen=True, slots=True)
class FalsifiedFinding:
    """Failed simulations of a plant of one kind: how many, and the first of them."""

    JSON: ClassVar = (
        "reason=finding.reason message=finding.message time=finding.time stderr=finding.stderr simulations "
        "point=finding.point file replay"
    )

    finding: PlantFinding
    simulations: int
    file: str
    replay: str


@dataclass(frozen=True, slots=True)
class FalsifiedSystem:
    """Searches for violations of the requirements of a system or run; failures are those of a plant.

    `lost` simulations were lost with their processes, for `reasons`.
    """

    JSON: ClassVar = "target simulations seed coordinates failures findings requirements lost"

    target: str
    simulations: int
    seed: int
    coordinates: int
    failures: tuple[str, ...]
    findings: tuple[FalsifiedFinding, ...]
    requirements: tuple[FalsifiedRequirement, ...]
    lost: int
    reasons: tuple[str, ...] = ()

    def __repr__(self) -> str:
        each = (f"{each.search.requirement} {each.verdict}" for each in self.requirements)
        return f"FalsifiedSystem({self.target}: {', '.join(each)})"

    @property
    def violated(self) -> bool:
        """True if a requirement is violated."""
        return any(each.verdict == "violated" for each in self.requirements)


@dataclass(frozen=True, slots=True)
class ReplayedCounterexample:
    """Counterexample that was simulated again, and the signals that differ from its trace."""

    requirement: str
    verdict: Literal["violated", "satisfied", "inconclusive", "out of scope"]
    margin: Num
    stored_margin: Num
    identical: bool
    different: list[str]


@dataclass(frozen=True, slots=True)
class ReplayedFinding:
    """Failed simulation of a plant that was simulated again; without a reason if it gives a trace now."""

    JSON: ClassVar = "reason message time stored_reason identical"

    reason: str | None
    message: str | None
    time: float | None
    stored_reason: str
    identical: bool
    stderr: str = ""


# ---------------------------------------------------------------------- files


@dataclass(frozen=True, slots=True)
class StoredSettings:
    """Settings of the simulations of a counterexample."""

    JSON: ClassVar = "guard agents steps scenario seed set=overrides"

    guard: str = GUARDS.default
    agents: Annotated[int, 0] | None = None
    steps: Annotated[int, 0] | None = None
    scenario: str | None = None
    seed: Annotated[int, 0] = 0
    overrides: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StoredCounterexample:
    """File of a counterexample."""

    JSON: ClassVar = "format requirement margin trace settings point"

    requirement: str
    margin: Num
    trace: str
    settings: StoredSettings
    point: list[float]
    format: Literal["stlc-counterexample/1"] = "stlc-counterexample/1"


@dataclass(frozen=True, slots=True)
class StoredFinding:
    """File of a failed simulation of a plant."""

    JSON: ClassVar = "format reason message time stderr settings values point"

    reason: str
    message: str
    settings: StoredSettings
    point: list[float]
    time: float | None = None
    stderr: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    format: Literal["stlc-finding/1"] = "stlc-finding/1"
