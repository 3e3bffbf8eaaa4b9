"""Contents of a training run's folder that a report shows; every part is optional."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from stlc.diagnostics import StlcError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.load import load_system_decl
from stlc.dynamics.scenario import under
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.rundir import RunDir
from stlc.signature import Signature
from stlc.source import Source, Span
from stlc.trace import Trace
from stlc.view.held_out import HeldOut, load_held_out

T = TypeVar("T")
Record = Mapping[str, Any]

TEXTS = (RunDir.SPEC, RunDir.SYSTEM, "compiled.txt", "config.resolved.yaml")


@dataclass(frozen=True, slots=True)
class StoredCause:
    """Cause of a loss, and its time in seconds."""

    why: str
    time: float


@dataclass(frozen=True, slots=True)
class StoredLoss:
    """A drive that broke rules."""

    seed: int
    agent: int
    lost: bool
    rules: dict[str, float | None]
    cause: StoredCause | None = None


@dataclass(frozen=True, slots=True)
class StoredVerdicts:
    """Verdicts on the drives under a guard."""

    count: int
    obeyed: int
    undecided: int
    lost: int
    rules: dict[str, dict[str, int]]
    broken: list[StoredLoss]
    told: int | None = None


@dataclass(frozen=True, slots=True)
class StoredMetric:
    """A metric over seeds."""

    mean: float
    high: float | None = None


@dataclass(frozen=True, slots=True)
class StoredGuard:
    """Results of the drives under a guard."""

    metrics: dict[str, StoredMetric | None] | None = None
    drives: StoredVerdicts | None = None
    units: dict[str, str] | None = None
    decisions: dict[str, float | None] | None = None
    latency: dict[str, float | None] | None = None


@dataclass(frozen=True, slots=True)
class StoredSimulation:
    """Content of `eval/simulate.json` as far as it is read."""

    spec: str
    scenario: str | None = None
    interval: str | None = None
    world: str | None = None
    agents: int | None = None
    steps: int | None = None
    ceiling: int | None = None
    time_limit: float | None = None
    paper_time_limit: float | None = None
    seeds: list[int] | None = None
    margin: dict[str, float] | None = None
    overrides: dict[str, str] | None = None
    guards: dict[str, StoredGuard] | None = None


@dataclass(frozen=True, slots=True)
class RunContents:
    """Contents of a run's folder; a part that is missing or unreadable is None or empty.

    Attributes:
        run: the run folder.
        record: content of `run.json`.
        rows: lines of `train.jsonl`.
        requirements: name -> declaration, parsed from the run's specification.
        outside: whether the specification uses external functions of its system.
        texts: file name -> text, for every file in the list `TEXTS` that exists.
        signature: names, units and labels of the system's states.
        held_out: held-out starts (initial states not used in training) and the robustness of the plans from
            them.
        simulation: content of `eval/simulate.json`, the results of the closed-loop runs.
        units: requirement -> unit of its robustness; it contains only requirements that have a unit.
        usual: default numbers of agents and steps that the system has in the scenario of the closed-loop
            runs.
        trace: trace recorded in the closed-loop runs.
        system: text of the system file.
    """

    run: RunDir
    record: Record
    rows: Sequence[Record]
    requirements: Mapping[str, ast.Require]
    outside: bool
    texts: Mapping[str, str]
    signature: Signature | None
    held_out: HeldOut | None
    simulation: Record | None
    units: Mapping[str, str]
    usual: Record
    trace: Trace | None
    system: Source | None

    @property
    def result(self) -> Record:
        """Result of the training run, from `run.json`; empty until the run is finished."""
        result = self.record.get("result")
        return result if isinstance(result, Mapping) else {}

    @property
    def spec(self) -> str:
        """Name of the specification."""
        return str(self.record.get("spec", "specification"))


def read_contents(run: RunDir) -> RunContents:
    """Read all parts of a run folder that a report can show.

    Raises:
        RunError: R101, the folder is not a run.
    """
    system = run.source(RunDir.SYSTEM) if run.has(RunDir.SYSTEM) else None
    decl = None if system is None else readable(lambda: load_system_decl(system))
    simulation = simulation_of(run)
    read = {name: run.read(name).decode("utf-8", "replace") for name in TEXTS if run.has(name)}
    spec = readable(
        lambda: replace(Spec.parse(Source(RunDir.SPEC, read.get(RunDir.SPEC, ""))), library=run.library())
    )
    scenario = (simulation or {}).get("scenario")
    deployed = decl if decl is None or scenario is None else readable(lambda: under(decl, str(scenario)))
    return RunContents(
        run=run,
        record=run.record(),
        rows=run.rows(),
        requirements={} if spec is None else spec.requirements,
        outside=spec is not None and bool(spec.functions),
        texts={name: text for name, text in read.items() if text},
        signature=None if decl is None else decl.signature,
        held_out=load_held_out(run),
        simulation=simulation,
        units={} if decl is None or spec is None else readable(lambda: _units(spec, decl)) or {},
        usual={} if deployed is None else {"agents": deployed.test.agents, "steps": deployed.test.steps},
        trace=archived(run, RunDir.TRACE, Trace.load),
        system=system,
    )


def simulation_of(run: RunDir) -> Record | None:
    """Content of `eval/simulate.json`; None without one. Raises RunError (R101, R110) if it is damaged."""
    found: Record | None = (
        run.read_json(RunDir.SIMULATION, StoredSimulation) if run.has(RunDir.SIMULATION) else None
    )
    return found


def readable(read: Callable[[], T]) -> T | None:
    """Call `read` and return its result, or None if the file is missing, damaged or invalid."""
    try:
        return read()
    except (OSError, StlcError):
        return None


def archived(run: RunDir, name: str, read: Callable[[Path], T]) -> T | None:
    """Call `read` on an archive of the run; None if the file is missing or damaged.

    Raises RunError (R110) if it is no file of the run.
    """
    path = run.file(name, RunDir.MOST_ARRAYS)
    return readable(lambda: read(path))


def untagged(declared: ast.Require) -> Span:
    """Source location of a requirement without the tags before it."""
    end = max((tag.span.end for tag in declared.tags), default=declared.span.start)
    text = declared.span.source.text
    start = max(end, declared.span.start)
    start += len(text[start : declared.span.end]) - len(text[start : declared.span.end].lstrip())
    return Span(declared.span.source, start, declared.span.end)


def _units(spec: Spec, decl: SystemDecl) -> dict[str, str]:
    rules = Monitor(spec, dt=decl.dt, horizon=decl.horizon * decl.dt).compiled.requirements
    return {rule.name: unit for rule in rules if (unit := rule.typed.formula.margin_unit)}
