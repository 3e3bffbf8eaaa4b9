"""Contents of a run's folder for a report; every part is optional."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stlc.compile.ir.traverse import margin_unit
from stlc.diagnostics import StlcError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.load import load_system_decl
from stlc.dynamics.scenarios.scenario import under
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse
from stlc.monitor.verdict import Monitor
from stlc.rundir import SIMULATION, TRACE, RunDir
from stlc.signature import Signature
from stlc.source import Source, Span
from stlc.trace import Trace, load_trace
from stlc.view.held_out import HeldOut, load_held_out

Record = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class RunContents:
    """The parts of one run.

    Attributes:
        run: its folder.
        record: of `run.json`.
        rows: of `train.jsonl`.
        requirements: name -> declaration, parsed from the run's specification.
        texts: `spec.stl`, `system.yaml`, `compiled.txt`, `config.resolved.yaml`, if present.
        signature: of the system, for units and labels.
        held_out: starts and robustness of their plans.
        simulation: of `eval/simulate.json`.
        units: requirement -> the unit of its robustness, where it has one.
        usual: default numbers of agents and steps of the system, under the deployment's scenario.
        trace: the recorded deployment.
    """

    run: RunDir
    record: Record
    rows: Sequence[Record]
    requirements: Mapping[str, ast.Require]
    texts: Mapping[str, str]
    signature: Signature | None
    held_out: HeldOut | None
    simulation: Record | None
    units: Mapping[str, str]
    usual: Record
    trace: Trace | None

    @property
    def result(self) -> Record:
        """Result of the training; empty until it is finished."""
        result = self.record.get("result")
        return result if isinstance(result, Mapping) else {}

    @property
    def outside(self) -> bool:
        """True if the specification uses external functions of its system."""
        return any(isinstance(item, ast.Extern) for item in _items(self.texts.get("spec.stl", "")))

    @property
    def spec(self) -> str:
        """Name of the specification."""
        return str(self.record.get("spec", "specification"))


def read_contents(run: RunDir) -> RunContents:
    """Read everything that a report can show.

    Raises:
        RunError: R101, the folder is no run.
    """
    decl, simulation = _decl(run), _simulation(run)
    texts = {name: text for name in TEXTS if (text := _text(run, name))}
    return RunContents(
        run=run,
        record=run.record(),
        rows=run.rows(),
        requirements=_requirements(texts.get("spec.stl", "")),
        texts=texts,
        signature=None if decl is None else decl.signature,
        held_out=load_held_out(run.path / "eval/held_out.npz"),
        simulation=simulation,
        units={} if decl is None else _units(texts.get("spec.stl", ""), decl),
        usual={} if decl is None else _usual(decl, (simulation or {}).get("scenario")),
        trace=_trace(run),
    )


def untagged(declared: ast.Require) -> Span:
    """A requirement without the tags before it."""
    end = max((tag.span.end for tag in declared.tags), default=declared.span.start)
    text = declared.span.source.text
    start = max(end, declared.span.start)
    start += len(text[start : declared.span.end]) - len(text[start : declared.span.end].lstrip())
    return Span(declared.span.source, start, declared.span.end)


TEXTS = ("spec.stl", "system.yaml", "compiled.txt", "config.resolved.yaml")


def _text(run: RunDir, name: str) -> str:
    try:
        return (run.path / name).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _requirements(text: str) -> dict[str, ast.Require]:
    return {item.name: item for item in _items(text) if isinstance(item, ast.Require)}


def _items(text: str) -> tuple[ast.Item, ...]:
    try:
        return tuple(parse(Source("spec.stl", text)).items)
    except StlcError:
        return ()


def _decl(run: RunDir) -> SystemDecl | None:
    try:
        return load_system_decl(run.path / "system.yaml")
    except StlcError:
        return None


def _units(text: str, decl: SystemDecl) -> dict[str, str]:
    try:
        monitor = Monitor(parse(Source("spec.stl", text)), dt=decl.dt, horizon=decl.horizon * decl.dt)
        rules = monitor.compiled.requirements
    except StlcError:
        return {}
    return {rule.name: unit for rule in rules if (unit := margin_unit(rule.typed.formula))}


def _usual(decl: SystemDecl, scenario: object) -> Record:
    try:
        test = (decl if scenario is None else under(decl, str(scenario))).test
    except StlcError:
        return {}
    return {"agents": test.agents, "steps": test.steps}


def _simulation(run: RunDir) -> Record | None:
    try:
        found = run.read_json(SIMULATION)
    except StlcError:
        return None
    return found if isinstance(found, Mapping) else None


def _trace(run: RunDir) -> Trace | None:
    path = run.path / TRACE
    if not path.exists():
        return None
    try:
        return load_trace(path)
    except StlcError:
        return None
