"""Options of proofs, searches for violations, certificates and simulations; no torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.diagnostics import usage
from stlc.options import Option, Options, parse_limit
from stlc.registry import GUARDS, PLANNERS
from stlc.rundir import RunDir

Plant = Annotated[Path | None, Option("A black box instead of a system (docs/plants.md).", "FILE")]
GuardName = Annotated[str, Option(metavar="|".join(GUARDS.installed))]
Requirements = Annotated[Sequence[str], Options.REQUIRE, tuple]
Agents = Annotated[int | None, Option("Agents in each world; by default the system's.", least=1)]
DriveSteps = Annotated[int | None, Option("Steps of each drive; by default the system's.", least=1)]
TimeLimit = Annotated[
    float | None,
    Option(
        "Time limit of a guard's decision per agent, or `none`; by default 100ms, or none of the paper's "
        "guard.",
        "TIME",
    ),
    parse_limit,
]
Margin = Annotated[
    Sequence[str],
    Option(
        "Safety margin that the guard requests; repeatable. `auto` calibrates it.", "M|NAME=M|auto", many=True
    ),
    tuple,
]
EACH = ", ".join(f"`{name}` {guard.help}" for name, guard in GUARDS.loaded().items() if guard.help)
"""Help of the guards that have one, such as "`full` also repairs plans"."""
Share = Annotated[float | None, Option(metavar="SHARE")]


@dataclass(frozen=True, slots=True, kw_only=True)
class VerifyOptions(Options):
    """Options of proofs on boxes of initial states.

    Attributes:
        controller (FILE): A network in ONNX that controls the system of SPEC.
        period: Control period of the network; by default the time step.
        continuous: Bound solutions of the differential equations, not the model's.
        budget: Time of the search for proofs; by default 60s.
        boxes: Boxes of each mode to examine at most.
        states: Random initial states around which to prove boxes.
        clock: Clock of the search for proofs; by default wall.
    """

    controller: Path | None = None
    period: Options.Seconds | None = None
    continuous: bool = False
    system: Options.System = None
    budget: Options.Seconds = 60.0
    boxes: Options.Positive | None = None
    states: Options.Natural = 0
    clock: Options.Clock = "wall"
    jobs: Options.Jobs = 1
    seed: Options.Seed = 0
    python: Options.Python = False
    runs: Options.Runs = RunDir.RUNS


@dataclass(frozen=True, slots=True, kw_only=True)
class FalsifyOptions(Options):
    """Options of a search for violations.

    Attributes:
        simulations: Simulations per requirement at most.
        budget: Time per requirement at most; by default no limit.
        batch: Points that a search proposes at a time; by default number of processes.
        random: Draw from the declared distributions only, as a baseline.
        guard: Guard of the policy.
        agents: Agents in each world of a run.
        steps: Steps of each drive of a run.
        scenario (NAME): Scenario of a run.
        out (DIR): Folder of the counterexamples.
        replay (FILE): Simulate this counterexample again, and compare.
    """

    system: Options.System = None
    plant: Plant = None
    require: Requirements = ()
    simulations: Options.Positive = 300
    budget: Options.Seconds | None = None
    seed: Options.Seed = 0
    jobs: Options.Jobs = 1
    cluster: Options.Cluster = None
    batch: Options.Positive | None = None
    random: bool = False
    guard: GuardName = GUARDS.default
    agents: Options.Positive | None = None
    steps: Options.Positive | None = None
    scenario: str | None = None
    out: Annotated[Path, Option(flags=("--out", "-o"))] = Path("counterexamples")
    replay: Path | None = None
    overrides: Options.Overrides = field(default_factory=dict)
    runs: Options.Runs = RunDir.RUNS


def _shift(text: str) -> float:
    from stlc.assurance.conformal import parse_shift

    return parse_shift(text)


@dataclass(frozen=True, slots=True, kw_only=True)
class CertifyOptions(Options):
    """Options of a certificate.

    Attributes:
        share: Share of drives to certify; by default .99, unless --width is given.
        confidence (P): Confidence of each bound.
        width (W): Drive until the interval of the share is as narrow as this.
        shift (D): Total variation between the distribution of future drives and that of these.
        guard: Guard of the policy.
        scenario (NAME): A scenario of the system.
        system (FILE): A system without controls, for a specification.
        seeds: Drive these seeds, such as 0..99, whatever they show; by default fresh ones, as needed.
        drives: Independent drives or simulations at most; worlds, where agents share one.
        out (FILE): File of the certificate; by default eval/certificate.json of the run, or
            certificates/NAME.json.
        verify (FILE): Compare a certificate with what it names, or with what is given.
    """

    share: Share = None
    confidence: float = 0.95
    width: float | None = None
    shift: Annotated[float | None, Option(), _shift] = None
    guard: GuardName = GUARDS.default
    time_limit: TimeLimit = None
    margin: Margin = ()
    scenario: str | None = None
    steps: DriveSteps = None
    agents: Agents = None
    plant: Plant = None
    system: Annotated[str | None, Option(flags=("--system", "-s"))] = None
    jobs: Options.Jobs = 1
    seeds: Options.Seeds | None = None
    drives: Options.Positive = 1000
    require: Requirements = ()
    out: Path | None = None
    verify: Path | None = None
    overrides: Options.Overrides = field(default_factory=dict)
    runs: Options.Runs = RunDir.RUNS


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateOptions(Options):
    """Options of closed-loop runs of a policy, a planner or a plant.

    Attributes:
        backup: Guard by the paper's backup policy, as --guard paper does.
        known_feasible: Number of visited states to check for a feasible plan.
        seeds: Such as 0..9 or 0,3; by default 0..9.
        record (FILE): Also write the trace to this file (.npz, .csv, .mcap).
        certify: Bound the share that satisfies everything, with 95 % confidence; the exit code says whether
            it is at least SHARE.
        scenario (NAME): A scenario, `all` scenarios of the system file, or `disturbed`.
        budget: With --method: processor time per plan; by default 20ms.
        start (POINT): With --plant: values, such as `h=1 m, e=0.7`.
        stream: With --plant: judge while it runs, in constant memory.
        pictures: Draw pictures and the report.
    """

    backup: Annotated[bool | None, Option(flags=("--backup/--no-backup",))] = None
    guard: Annotated[str | None, Option(f"Guard; {EACH}; by default none.", "|".join(GUARDS.installed))] = (
        None
    )
    time_limit: TimeLimit = None
    known_feasible: Options.Natural = 0
    margin: Margin = ()
    seeds: Options.Seeds = tuple(range(10))
    steps: DriveSteps = None
    agents: Agents = None
    record: Path | None = None
    certify: Share = None
    scenario: str | None = None
    method: Annotated[
        str | None,
        Option(
            "A planner, for a specification, or beside the policy of a run: "
            f"{', '.join(PLANNERS.installed)}, or FILE.py.",
            "PLANNER",
            ("--method", "-m"),
        ),
    ] = None
    options: Options.OfMethod = field(default_factory=dict)
    budget: Options.Seconds | None = None
    plant: Plant = None
    start: Annotated[str | None, Option(flags=("--from",))] = None
    jobs: Options.Jobs = 1
    stream: bool = False
    system: Options.System = None
    overrides: Options.Overrides = field(default_factory=dict)
    runs: Options.Runs = RunDir.RUNS
    pictures: Annotated[bool, Option(flags=("--pictures/--no-pictures",))] = False

    @property
    def guarded(self) -> str:
        """Name of the guard. Raises UsageError (U101) if `backup` and `guard` contradict each other."""
        if self.guard is None:
            return PAPER.name if self.backup else GUARDS.default
        if self.backup is not None and self.backup != (GUARDS.get(self.guard) is PAPER):
            option = "--backup" if self.backup else "--no-backup"
            raise usage(f"`{option}` and `--guard {self.guard}` contradict each other")
        return self.guard
