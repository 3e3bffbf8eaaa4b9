"""`python -m benchmarks schema`: JSON Schema of the JSON documents of all tables, derived from their rows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass, make_dataclass
from functools import reduce
from operator import or_
from types import UnionType
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

from benchmarks.claims import Claim
from benchmarks.deployments import DeploymentRow
from benchmarks.drives import DriveRow
from benchmarks.episodes import EpisodeSpeed
from benchmarks.feasible import KnownFeasible
from benchmarks.formulas import Timing
from benchmarks.plannings import PlanRow
from benchmarks.repairs import Mended
from benchmarks.steps import Speed, StepTiming
from benchmarks.tables import (
    ablation,
    ainncs,
    certificates,
    device,
    failures,
    falsify,
    family,
    latency,
    paper,
    streams,
    tasks,
    uncertain,
    verify,
)
from stlc.cli.framework.output import Document, emit
from stlc.cli.framework.program import command
from stlc.jsontext import Num
from stlc.records import schema_of

NAME = "benchmarks/1"


@dataclass(frozen=True)
class FailedTraining:
    """Name of a measurement that failed, and the reason."""

    name: str
    why: str


@dataclass(frozen=True)
class Facts:
    """Entries of a table's JSON document other than its rows; each table has some of them."""

    JSON: ClassVar = "page? results? trained? kept? driven? planned? failed?"

    page: str
    results: int
    trained: int
    kept: int
    driven: int
    planned: int
    failed: list[FailedTraining]


ROWS: dict[str, dict[str, type]] = {
    "paper": {
        **{"rows": paper.LearnedRow, "known_feasible": KnownFeasible},
        **{"plans": PlanRow, "drives": DriveRow, "claims": Claim},
    },
    "ablation": {"rows": ablation.AblationRow},
    "failures": {"rows": failures.FailuresRow},
    "falsify": {"rows": falsify.FalsifyRow},
    "family": {"rows": family.FamilyRow},
    "worlds": {"rows": DeploymentRow},
    "disturbed": {"rows": DeploymentRow},
    "latency": {"rows": latency.LatencyRow},
    "device": {"rows": device.DeviceRow},
    "repair": {"rows": Mended},
    "step": {"steps": StepTiming, "speeds": Speed},
    "robustness": {"rows": Timing},
    "uncertain": {"rows": uncertain.Overhead},
    "gym": {"rows": EpisodeSpeed},
    "certificates": {"rows": certificates.CertificatesRow},
    "verify": {"rows": verify.VerifyRow},
    "ainncs": {"rows": ainncs.AinncsRow},
    "tasks": {"rows": tasks.TaskRow},
    "streams": {"rows": streams.StreamRow, "agreement": streams.AgreementRow},
}
"""Name of a table -> key in its result -> record of a row."""


@command("python -m benchmarks schema")
def schema() -> None:
    """Print the JSON Schema of the documents that tables print with --json.

    Within a major version, keys are only added.
    """
    emit(json.dumps(document_schema(), indent=2))


def document_schema() -> dict[str, Any]:
    """Return the schema of a whole document: keys that all commands share, and the result of one table."""
    results = [_result(name, rows) for name, rows in ROWS.items()]
    frame = schema_of(Document)
    frame["properties"] |= {"schema": {"const": NAME}, "result": schema_of(reduce(or_, [*results, None]))}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": NAME, **frame}


def _result(name: str, rows: Mapping[str, type]) -> Any:
    lists = {key: list[document_type(row)] for key, row in rows.items()}  # type: ignore[misc]
    keys = " ".join(("what", *lists, Facts.JSON))
    return make_dataclass(
        name, {"what": Literal[name], **lists}.items(), bases=(Facts,), frozen=True, namespace={"JSON": keys}
    )


def document_type(kind: Any) -> Any:
    """Return the type of the JSON form of values of the type `kind`.

    A dataclass becomes one that has its properties as fields.
    """
    origin, args = get_origin(kind), get_args(kind)
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        hints |= {
            name: get_type_hints(each.fget)["return"]
            for name, each in vars(kind).items()
            if isinstance(each, property)
        }
        return make_dataclass("Record", [(key, document_type(hint)) for key, hint in hints.items()])
    if kind is float:
        return Num
    if origin in (Union, UnionType):
        return Union[tuple(map(document_type, args))]  # noqa: UP007
    if origin is tuple and args[-1] is Ellipsis:
        return list[document_type(args[0])]  # type: ignore[misc]
    if origin is tuple:
        return tuple[tuple(map(document_type, args))]  # type: ignore[misc]
    if origin is Mapping:
        return dict[str, document_type(args[1])]  # type: ignore[misc]
    return kind
