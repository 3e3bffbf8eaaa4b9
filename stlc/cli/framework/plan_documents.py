"""Records that `stlc plan` prints; see `stlc.cli.framework.documents`."""

from typing import Any, NotRequired, TypedDict


class PlanRobustness(TypedDict):
    """Robustness of the best plans over all initial states."""

    least: float | str
    median: float | str
    greatest: float | str


class PlanSeconds(TypedDict):
    """Processor time of a plan, in seconds."""

    mean: float
    median: float
    most: float


class GuaranteedRobustness(TypedDict):
    """Bounds on the robustness of a requirement over all initial states, and the plans that satisfy it."""

    low: float | str
    high: float | str
    guaranteed: int


class PlanTubes(TypedDict):
    """Bounds for all errors of a scenario; normal noise is bounded at a number of standard deviations.

    `numbers` are the numbers of the dynamics that may be wrong; constants in `exact` are not, as conditions
    or limits read them.
    """

    scenario: str
    deviations: float | None
    numbers: list[str]
    exact: list[str]
    guaranteed: int
    robustness: list[float | str]
    requirements: dict[str, GuaranteedRobustness]


class Plans(TypedDict):
    """Result of `stlc plan`."""

    spec: str
    system: str
    method: str
    budget: float
    starts: int
    satisfied: int
    infeasible: int
    robustness: PlanRobustness
    seconds: PlanSeconds
    evaluations: float
    missed: list[dict[str, Any]]
    better: dict[str, Any] | None
    tube: NotRequired[PlanTubes]
    trace: str
