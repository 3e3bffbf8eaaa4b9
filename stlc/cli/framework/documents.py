"""Documents that commands print with `--json`, as typed records from which their JSON Schemas are derived.

Times are in seconds, positions count from 1. A number (`Num`) that is not finite is a text. Within one major
version of a schema, keys are added and never removed.
"""

from typing import Annotated, Any, Literal, NotRequired, TypeAlias, TypedDict

from stlc.controller.evaluation.closed_loop import ClosedLoop
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


class FalsificationRounds(TypedDict):
    """Rounds of `stlc train --falsify`; see `stlc.controller.training.failures.FailureStates`."""

    rounds: int
    drives: int
    failing: int
    last_share: float
    states: int


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
