"""Records that `stlc simulate` prints for plants; see `stlc.cli.framework.documents`."""

from typing import Literal, TypeAlias, TypedDict

Num: TypeAlias = float | str


class PlantRequirement(TypedDict):
    name: str
    verdict: str
    robustness: Num
    low: Num
    high: Num
    unit: str


class PlantFailure(TypedDict):
    reason: str
    message: str
    time: float | None
    stderr: str


class PlantRunRecord(TypedDict):
    seed: int
    point: dict[str, float]
    samples: int
    verdict: Literal["satisfied", "violated", "inconclusive", "out of scope", "finding"]
    requirements: list[PlantRequirement]
    finding: PlantFailure | None


class PlantSimulation(TypedDict):
    spec: str
    plant: str
    kind: str
    dt: float
    steps: int
    streamed: bool
    satisfied: int
    violated: int
    inconclusive: int
    out_of_scope: int
    findings: int
    trace: str | None
    runs: list[PlantRunRecord]
