"""Results of the commands, from which the JSON Schemas of their documents are derived."""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from operator import or_
from typing import Any, TypedDict

from stlc.diagnostics import Diagnostic

_DOCUMENTS = "stlc.cli.framework.documents"
RESULTS: dict[str, tuple[str, ...]] = {
    "certify": (
        "stlc.assurance.certificates:BoundedDrives",
        "stlc.assurance.certificates:BoundedDraws",
        "stlc.assurance.campaign:CertificateCheck",
    ),
    "check": ("stlc.assurance.certificate:BoundedVerdict", "stlc.assurance.certificate:JudgedFiles"),
    "compile": (
        "stlc.compile.described:CompiledSpec",
        f"{_DOCUMENTS}:ParsedFile",
        f"{_DOCUMENTS}:ParsedFiles",
    ),
    "doctor": (f"{_DOCUMENTS}:InstallationReport",),
    "explain": (
        "stlc.grammar.manual:CodeList",
        "stlc.grammar.manual:Page",
        "stlc.grammar.manual:SpecInWords",
        "stlc.monitor.explain.tree:Explanation",
        "stlc.controller.guard.coverage:Guarantee",
    ),
    "export": ("stlc.export.write:Exported", "stlc.export.monitor:ExportedMonitor"),
    "falsify": (
        "stlc.assurance.falsified:FalsifiedSystem",
        "stlc.assurance.falsified:ReplayedCounterexample",
        "stlc.assurance.falsified:ReplayedFinding",
    ),
    "fmt": (f"{_DOCUMENTS}:FormattedFiles",),
    "init": (f"{_DOCUMENTS}:CreatedFiles",),
    "lint": ("stlc.monitor.linted:Lint",),
    "plan": ("stlc.assurance.verification.planned:Plans",),
    "plot": (f"{_DOCUMENTS}:PlottedTrace",),
    "report": ("stlc.view.report:Report",),
    "runs": tuple(
        f"{_DOCUMENTS}:{name}" for name in ("RunList", "RunComparison", "RunContent", "RemovedRuns")
    ),
    "simulate": ("stlc.assurance.simulated:Simulation", "stlc.plants.judge:PlantSimulation"),
    "stlc": (),
    "system": ("stlc.dynamics.facts:SystemList", "stlc.dynamics.facts:SystemFacts"),
    "train": (f"{_DOCUMENTS}:TrainedRun", f"{_DOCUMENTS}:TrainedRuns"),
    "verify": ("stlc.assurance.verification.verified:Verified",),
}
"""Name of a command, or `stlc` for those without a result -> `module:class` of its results."""


class DocumentRecord(TypedDict):
    """Keys that the documents of all commands share."""

    stlc: str
    schema: str
    ok: bool
    exit_code: int
    diagnostics: list[Diagnostic]
    result: Any


def result_of(command: str) -> Any:
    """Type of the result of a command, or None."""
    places = (place.partition(":") for place in RESULTS[command])
    return reduce(or_, [getattr(import_module(module), name) for module, _, name in places], None)
