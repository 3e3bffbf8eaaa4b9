"""Records of statistical bounds, certificates and counterexamples, as `--json` prints them."""

from typing import Annotated, Any, Literal, TypeAlias, TypedDict

from stlc.assurance.certificate import Assessment
from stlc.assurance.draws import FailedDraw
from stlc.controller.guard.kind import compared_guards
from stlc.registry import GUARDS

Num: TypeAlias = float | str
Count = Annotated[int, 0]
GuardName = Annotated[str, lambda: GUARDS.installed]
ComparedGuard = Annotated[str, compared_guards]


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


class Certificate(TypedDict):
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


class CertifiedFindings(TypedDict):
    """Number of failed simulations, and the first of them."""

    count: Count
    first: list[FailedDraw]


class DrawnCertificate(TypedDict):
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


BoundedDrives: TypeAlias = Annotated[Assessment, Certificate]
BoundedDraws: TypeAlias = Annotated[Assessment, DrawnCertificate]
"""Bounds and what they depend on, the content of a certificate."""


class FalsificationRounds(TypedDict):
    """Rounds of `stlc train --falsify`; see `stlc.controller.training.failures.FailureBank`."""

    rounds: int
    drives: int
    failing: int
    last_share: float
    states: int
