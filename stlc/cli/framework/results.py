"""Results of the commands, from which the JSON Schemas of their documents are derived."""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from operator import or_
from typing import Any

_COMMANDS = "stlc.cli.commands"
RESULTS: dict[str, tuple[str, ...]] = {
    "certify": (
        "stlc.assurance.certificates:BoundedDrives",
        "stlc.assurance.certificates:BoundedDraws",
        "stlc.assurance.campaign:CertificateCheck",
    ),
    "check": ("stlc.assurance.certificate:BoundedVerdict", "stlc.assurance.certificate:JudgedFiles"),
    "compile": (
        "stlc.compile.described:CompiledSpec",
        f"{_COMMANDS}.compile:ParsedFile",
        f"{_COMMANDS}.compile:ParsedFiles",
    ),
    "doctor": (f"{_COMMANDS}.doctor:InstallationReport",),
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
    "fmt": (f"{_COMMANDS}.fmt:FormattedFiles",),
    "init": (f"{_COMMANDS}.init:CreatedFiles",),
    "lint": ("stlc.monitor.linted:Lint",),
    "plan": ("stlc.assurance.verification.planned:Plans",),
    "plot": (f"{_COMMANDS}.plot:PlottedTrace",),
    "report": ("stlc.view.report:Report",),
    "runs": tuple(
        f"{_COMMANDS}.runs:{name}" for name in ("RunList", "RunComparison", "RunContent", "RemovedRuns")
    ),
    "simulate": ("stlc.assurance.simulated:Simulation", "stlc.assurance.plant_judge:PlantSimulation"),
    "stlc": (),
    "system": ("stlc.dynamics.facts:SystemList", "stlc.dynamics.facts:SystemFacts"),
    "train": (f"{_COMMANDS}.train.trained:TrainedRun", f"{_COMMANDS}.train.trained:TrainedRuns"),
    "verify": ("stlc.assurance.verification.verified:Verified",),
}
"""Name of a command, or `stlc` for those without a result -> `module:class` of its results."""


def result_of(command: str) -> Any:
    """Type of the result of a command, or None."""
    places = (place.partition(":") for place in RESULTS[command])
    return reduce(or_, [getattr(import_module(module), name) for module, _, name in places], None)
