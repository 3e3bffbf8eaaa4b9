"""Documents that commands print with `--json`, as typed records from which their JSON Schemas are derived.

Times are in seconds, positions count from 1. A number (`Num`) that is not finite is a text. Within one major
version of a schema, keys are added and never removed.
"""

from typing import Annotated, Any, Literal, NotRequired, TypeAlias, TypedDict

from stlc.assurance.certificate import Assessment
from stlc.cli.framework.assured import FalsificationRounds
from stlc.controller.evaluation.closed_loop import ClosedLoop
from stlc.controller.evaluation.deployment import DecisionLatency
from stlc.controller.evaluation.stats import MeanInterval
from stlc.view.learning import Learning

Num: TypeAlias = float | str
Count = Annotated[int, 0]
Positive = Annotated[float, 0]
"""Numbers that are not negative."""


class ParsedFile(TypedDict):
    file: str
    tree: dict[str, Any]


class ParsedFiles(TypedDict):
    files: list[ParsedFile]


class InstallationFinding(TypedDict):
    name: str
    state: Literal["ok", "missing", "off"]
    detail: str


class InstallationReport(TypedDict):
    findings: list[InstallationFinding]


class FormattedFiles(TypedDict):
    files: list[str]
    changed: list[str]
    written: bool
    diff: NotRequired[str]


class CreatedFiles(TypedDict):
    files: list[str]


class PlottedTrace(TypedDict):
    trace: str
    picture: str
    shown: list[int]


class ListedRun(TypedDict):
    run: str
    path: str
    status: str
    accuracy: float | None
    spec: Any
    system_path: Any
    steps: Any
    seed: Any
    started: Any


class RunList(TypedDict):
    runs: list[ListedRun]


class DifferentFact(TypedDict):
    key: str
    values: list[str]


class RunComparison(TypedDict):
    runs: list[str]
    facts: list[DifferentFact]
    files: list[str]


class RunContent(TypedDict):
    run: str
    record: dict[str, Any]
    files: list[str]


class RemovedRuns(TypedDict):
    removed: list[str]


class UnsafeStart(TypedDict):
    seed: int
    agent: int
    savable: bool


class RuleCounts(TypedDict):
    obeyed: Count
    broken: Count
    undecided: Count


class LossCause(TypedDict):
    why: Literal["start", "told", "later", "missed", "near", "rules"]
    time: Positive


class BrokenRun(TypedDict):
    seed: int
    agent: Count
    lost: bool
    rules: dict[str, float | None]
    cause: LossCause | None


class JudgedRuns(TypedDict):
    count: Count
    obeyed: Count
    safe: Count | None
    undecided: Count
    lost: Count
    told: Count
    rules: dict[str, RuleCounts]
    broken: list[BrokenRun]


class GuardedRuns(TypedDict):
    metrics: dict[str, MeanInterval]
    units: dict[str, str]
    decisions: dict[str, Num]
    unsafe: NotRequired[list[UnsafeStart]]
    latency: DecisionLatency
    search: NotRequired[dict[str, Num]]
    drives: NotRequired[JudgedRuns]
    assurance: NotRequired[Assessment]


class ModelErrors(TypedDict):
    actuator_gain: NotRequired[float]
    parameters: NotRequired[float]
    actuator_noise: NotRequired[float]
    sensor_noise: NotRequired[float]
    numbers: NotRequired[list[str]]
    exact: NotRequired[list[str]]


class JudgeSpec(TypedDict):
    spec: str
    path: str
    rules: dict[str, str]


class ScenarioResult(TypedDict):
    doc: str
    expect: Literal["nominal", "ood"]
    guards: dict[str, GuardedRuns]
    judge: NotRequired[JudgeSpec | None]


class LiveMargin(TypedDict):
    status: Literal["satisfied", "violated", "inconclusive"]
    low: Num
    high: Num
    violated: Count


class RobustnessLine(TypedDict):
    step: Count
    t: float
    seed: int
    agent: Count
    decided: str | None
    plan_rho: Num | None
    policy_rho: Num | None
    plan_safe: bool | None
    margins: dict[str, LiveMargin]


class Simulation(TypedDict):
    scenarios: NotRequired[dict[str, ScenarioResult]]
    spec: str
    system: str
    run: str
    world: str | None
    scenario: str | None
    trace: str
    seeds: list[int]
    agents: int
    steps: int
    replan: int
    starts: NotRequired[Literal["any", "savable", "feasible"]]
    redrawn: NotRequired[Count]
    time_limit: NotRequired[float | None]
    paper_time_limit: NotRequired[float | None]
    ceiling: NotRequired[int]
    overrides: NotRequired[dict[str, str]]
    interval: str
    guards: dict[str, GuardedRuns]
    planners: NotRequired[dict[str, GuardedRuns]]
    animation: NotRequired[str]
    report: NotRequired[str]
    errors: NotRequired[ModelErrors]
    margin: NotRequired[dict[str, Positive]]
    safety: NotRequired[list[str]]
    judge: NotRequired[JudgeSpec | None]


class Training(TypedDict):
    accuracy: NotRequired[float]
    interval: NotRequired[list[float]]
    held_out: NotRequired[int]
    requirements: NotRequired[dict[str, float]]
    feasible: NotRequired[float]
    searched: NotRequired[int]
    judged_seconds: NotRequired[float]
    closed_loop: NotRequired[ClosedLoop]
    falsification: NotRequired[FalsificationRounds]
    verdict: NotRequired[Learning]
    steps: NotRequired[int | None]
    schedule: NotRequired[str | None]


class TrainedRun(Training):
    run: str
    seconds: float


class TrainedJob(Training):
    spec: str
    seed: NotRequired[int]
    exit_code: int
    why: NotRequired[str]
    run: NotRequired[str]
    seconds: NotRequired[float]


class TrainedRuns(TypedDict):
    runs: list[TrainedJob]
