"""Records of statistical bounds, certificates and counterexamples, as `--json` prints them."""

from typing import Annotated, Any, Literal, TypeAlias, TypedDict, final

from stlc.controller.guard.kind import compared_guards
from stlc.registry import GUARDS

Num: TypeAlias = float | str
Count = Annotated[int, 0]
GuardName = Annotated[str, lambda: GUARDS.installed]
ComparedGuard = Annotated[str, compared_guards]


class ShareStatement(TypedDict):
    """Bounds on one requirement from a sample of drives; see `stlc.assurance.certificate.Statement`."""

    name: str
    drives: Count
    satisfied: Count
    undecided: Count
    units: Count
    share: float
    lower: float
    upper: float
    interval: list[float]
    method: Literal["Clopper-Pearson", "betting"]
    lower_any_time: float
    lower_fixed: float | None
    lower_deployed: float
    upper_deployed: float
    whole_units: Count
    whole_units_lower: float
    next_robustness: Num
    reached_robustness: Num
    robustness_unit: str
    observed: list[list[float]]
    observed_high: list[list[float]]


class OnlineMargins(TypedDict):
    """Bound while driving: the robustness of the followed plan less the margin of the step."""

    margins: list[Num]
    confidence: float
    units: Count


class NeededUnits(TypedDict):
    """Numbers of units without a failure that certify the share, and that bound the next robustness."""

    units: Count
    robustness: int | None


class Assurance(TypedDict):
    """Bounds from a sample of drives, with their assumptions in words."""

    answer: Literal["certified", "refuted", "undecided", "measured"]
    share: float | None
    confidence: float
    shift: str | None
    sequential: bool
    unit: Literal["world", "drive", "trace", "simulation"]
    calibration: Count
    left_out: Count
    needed: NeededUnits
    overall: ShareStatement
    requirements: list[ShareStatement]
    online: OnlineMargins | None
    assumptions: list[str]


class CertifiedInputs(TypedDict):
    """Hashes and versions of the inputs of the drives."""

    spec: str
    system: str
    functions: str
    rules: str | None
    world: str | None
    policy: str
    guard_version: int


class CertifiedConditions(TypedDict):
    """Options of the deployment; seeds are ranges [first, last]."""

    guard: GuardName
    scenario: str | None
    overrides: dict[str, str]
    require: list[str]
    margin: dict[str, float]
    time_limit: float | None
    agents: Count
    steps: Count
    replan: Count
    seeds: list[list[int]]


@final
class Certificate(Assurance):
    """Content of a certificate file."""

    certificate: str
    made: str
    run: str
    spec: str
    system: str
    width: float | None
    finished: bool
    batches: Count
    inputs: CertifiedInputs
    conditions: CertifiedConditions
    versions: dict[str, str]
    hardware: dict[str, Any]


class DrawnConditions(TypedDict):
    """Options of the simulations of a plant or system; seeds are ranges [first, last]."""

    overrides: dict[str, str]
    require: list[str]
    seeds: list[list[int]]


class CertifiedFinding(TypedDict):
    """Simulation of a plant that failed; see `stlc.plants.plant.PlantFinding`."""

    seed: int
    reason: str
    message: str
    time: float | None
    point: dict[str, float]


class CertifiedFindings(TypedDict):
    """Number of failed simulations, and the first of them."""

    count: Count
    first: list[CertifiedFinding]


@final
class DrawnCertificate(Assurance):
    """Content of the certificate file of a plant, or of a system without controls.

    The inputs are hashes: of the specification, of the plant or system file, and of the files that it names.
    """

    certificate: str
    made: str
    kind: Literal["plant", "system"]
    spec: str
    spec_file: str
    system: str
    system_file: str
    width: float | None
    finished: bool
    batches: Count
    inputs: dict[str, str]
    conditions: DrawnConditions
    findings: CertifiedFindings
    versions: dict[str, str]
    hardware: dict[str, Any]


class DifferentEntry(TypedDict):
    """Entry of a certificate that differs from the present run."""

    name: str
    certificate: str
    present: str


class CertificateCheck(TypedDict):
    """Comparison of a certificate with a run, or with a plant or system, whose file is then `run`."""

    file: str
    run: str
    same: bool
    inputs: list[DifferentEntry]
    numbers: list[str]
    software: list[DifferentEntry]


CertifyResult: TypeAlias = Certificate | DrawnCertificate | CertificateCheck
"""Result of `stlc certify`."""


class Violation(TypedDict):
    """Simulation that violates a requirement; see `stlc.assurance.falsify.Counterexample`."""

    margin: Num
    half_step: Num | None
    strategy: str
    simulation: int


class FalsifiedRequirement(TypedDict):
    """Search for a violation of one requirement; see `stlc.assurance.falsify.Falsification`.

    It is inconclusive if no simulation has a verdict.
    """

    name: str
    verdict: Literal["violated", "open", "inconclusive"]
    simulations: int
    inconclusive: int
    least: Num
    found: Violation | None
    simpler: Violation | None
    spurious: list[Violation]
    coverage: float
    rejected: int
    seconds: float
    strategies: dict[str, int]
    file: str | None
    replay: str | None
    trace_margin: Num | None


class FalsifiedFinding(TypedDict):
    """Failed simulations of a plant of one kind: how many, and the first of them."""

    reason: str
    message: str
    time: float | None
    stderr: str
    simulations: int
    point: dict[str, float]
    file: str
    replay: str


class FalsifiedSystem(TypedDict):
    """Searches for violations of the requirements of a system or run; failures are those of a plant."""

    target: str
    simulations: int
    seed: int
    coordinates: int
    failures: list[str]
    findings: list[FalsifiedFinding]
    lost: int
    requirements: list[FalsifiedRequirement]


class ReplayedCounterexample(TypedDict):
    """Counterexample that was simulated again, and how it differs from its trace."""

    requirement: str
    verdict: Literal["violated", "satisfied", "inconclusive", "out of scope"]
    margin: Num
    stored_margin: Num
    identical: bool
    different: list[str]


class ReplayedFinding(TypedDict):
    """Failed simulation of a plant that was simulated again; without a reason if it gives a trace now."""

    reason: str | None
    message: str | None
    time: float | None
    stored_reason: str
    identical: bool


FalsifyResult: TypeAlias = FalsifiedSystem | ReplayedCounterexample | ReplayedFinding
"""Result of `stlc falsify`."""


class UncertainSignal(TypedDict):
    """Greatest error of the samples of a signal; see `stlc.monitor.uncertain.Uncertainty`."""

    absolute: Num
    relative: Num
    unit: str


class VerifiedMode(TypedDict):
    """Proved, refuted and open shares of one mode of the initial states."""

    name: str
    probability: Num
    proved: Num
    refuted: Num
    open: Num
    proved_boxes: int
    examined_boxes: int
    witness: dict[str, Num] | None
    robustness: Num | None
    states: int
    states_proved: int
    states_violated: int


class Verified(TypedDict):
    """Proved, refuted and open shares of the initial states of a run."""

    run: str
    seconds: Num
    proved: Num
    refuted: Num
    open: Num
    states: int
    states_proved: int
    states_violated: int
    states_share: Num
    modes: list[VerifiedMode]


class GuardResult(TypedDict):
    """Drives under one guard after a training; see `stlc.controller.evaluation.closed_loop.Share`."""

    guard: ComparedGuard
    drives: int
    satisfied: int
    share: Num
    interval: list[Num]
    safe: Num | None
    compared: int
    gained: int
    lost: int
    broken: list[dict[str, Any]]
    causes: dict[str, int]


class ClosedLoopRecord(TypedDict):
    """Closed-loop results of a training; see `stlc.controller.evaluation.closed_loop.ClosedLoop`."""

    recommended: Annotated[str | None, lambda: (*compared_guards(), None)]
    share: Num | None
    interval: list[Num] | None
    guards: list[GuardResult]
    left_out: list[ComparedGuard]
    seed: int
    steps: int
    seconds: Num
    plan_seconds: Num
    judge: str | None
    why: str


class FalsificationRounds(TypedDict):
    """Rounds of `stlc train --falsify`; see `stlc.controller.training.failures.FailureBank`."""

    rounds: int
    drives: int
    failing: int
    last_share: float
    states: int
