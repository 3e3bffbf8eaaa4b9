"""Deployments (closed-loop simulations of policies) with guards, in scenarios; each is stored once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.options import Output, ResultsOption, SeedsOption, TrainedOption
from benchmarks.store import BENCHMARKS, Key, Result, ResultStore
from benchmarks.table import Table, listed, publish
from benchmarks.training import Place, benchmark_order
from stlc.cli.framework.output import say
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, simulate
from stlc.controller.evaluation.deployment import decided, feasible_states
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.metrics import METRICS, is_progress, measure
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kind import GuardKind, compared_guards
from stlc.controller.guard.kinds.full import GUARD as FULL
from stlc.controller.guard.margins import AUTO, MarginRequest, parse_margins
from stlc.controller.run.run import Run
from stlc.controller.search.feasibility import viable
from stlc.controller.world import world_type
from stlc.diagnostics import usage
from stlc.dynamics.declaration.deployment import ErrorsDecl
from stlc.dynamics.scenario import DISTURBED
from stlc.jsontext import plain
from stlc.options import parse_limit, parse_seeds
from stlc.provenance import sha256
from stlc.registry import GUARDS
from stlc.rundir import RunDir

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.problem.task import Task

NOMINAL = "as it is"
AGENTS = 5
"""Maximum number of agents in the deployments whose states are sampled."""
SCENARIOS = (NOMINAL, *DISTURBED)
USUAL = (*compared_guards(), f"{FULL.name}+{AUTO}")
"""Default guards. The text after a `+` is the safety margin that the guard requests; see `guard_of`."""


@dataclass(frozen=True, slots=True)
class DeploymentOptions:
    """Command-line options for deployments (closed-loop simulations of a policy)."""

    seeds: SeedsOption = "0..9"
    agents: Annotated[
        int | None, typer.Option("--agents", metavar="N", min=1, help="In each deployment, at most.")
    ] = None
    steps: Annotated[
        int | None, typer.Option("--steps", metavar="N", min=1, help="Of each deployment, at most.")
    ] = None
    time_limit: Annotated[
        str, typer.Option("--time-limit", metavar="TIME", help="Of a decision of the full guard, or `none`.")
    ] = "100ms"
    out: ResultsOption = Path("benchmarks/results")
    runs_folder: TrainedOption = Path("runs/benchmarks")

    def setting(self, run: Run, known_feasible: int) -> Setting:
        """Return the settings of the deployments of a run, such as the numbers of agents and steps.

        These numbers are at most the default numbers of the system. `known_feasible` is the number of visited
        states that are checked for a satisfying plan.
        """
        test = run.task.system.decl.test
        agents = min(self.agents or test.agents, test.agents)
        steps = min(self.steps or test.steps, test.steps)
        limit = parse_limit(self.time_limit)
        finite = limit if math.isfinite(limit) else None
        return Setting(parse_seeds(self.seeds), agents, steps, test.replan, finite, known_feasible)

    def runs(self, names: Sequence[str] | None) -> list[RunDir]:
        """Return the runs called `names`; without names, the most accurate run of each benchmark.

        Raises:
            UsageError: U101, there is no run of a benchmark.
        """
        if names:
            return [RunDir.open(name) for name in names]
        place = Place(ResultStore("paper", self.out), self.runs_folder)
        results = place.valid()
        own = [[each for each in results if each["key"]["benchmark"] == name] for name in BENCHMARKS]
        found = [run for each in own if each and (run := place.best_run(each)) is not None]
        if not found:
            help_ = ("python -m benchmarks paper  trains them", "or name runs")
            message = f"there are no policies of the benchmarks in `{self.runs_folder}`"
            raise usage(message, *help_)
        return found


def recorded(guard: Guard, setting: Setting) -> DeploymentRecording:
    """Simulate a policy with its guard in the world of its system, and return the recording.

    The world is the simulated environment.
    """
    recorder = Recorder(setting.agents)
    simulate(guard, world_type(guard.task.system.decl), setting, recorder)
    recording = recorder.recording()
    assert recording is not None
    return recording


def sampled_states(
    guard: Guard, seeds: tuple[int, ...], samples: int
) -> tuple[DeploymentRecording, NDArray[np.int64], NDArray[np.int64]]:
    """Simulate a deployment of few agents, and choose some of the visited states.

    A chosen state is given by its index (row, step) in the recording. A row is one agent with one seed.

    Returns:
        The recording; the indices of `samples / 2` states, evenly chosen from all, (k, 2); the indices of at
        most as many states in which the guard intervened, (l, 2). A good policy has few such states.
    """
    test = guard.task.system.decl.test
    recording = recorded(guard, Setting(seeds, min(AGENTS, test.agents), test.steps, test.replan))
    return recording, *picked(recording, samples)


def picked(recording: DeploymentRecording, samples: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of the states that `sampled_states` chooses from a recording."""
    every = np.argwhere(np.ones_like(recording.source, dtype=bool))
    acted = np.argwhere(recording.source > 0)
    half = max(samples // 2, 1)
    even, there = (
        rows[np.linspace(0, len(rows) - 1, min(half, len(rows))).astype(int)] for rows in (every, acted)
    )
    return even, there


def guard_of(name: str) -> tuple[GuardKind, MarginRequest]:
    """Parse a name such as `full`, `full+0.2` or `full+auto` into a guard and its requested safety margin.

    Raises:
        UsageError: U101, there is no such guard.
    """
    mode, _, margin = name.partition("+")
    return GUARDS.get(mode), parse_margins([margin] if margin else [])


@dataclass(slots=True)
class Deployments:
    """All deployments (closed-loop simulations) of one table.

    Each deployment is stored when it ends. A stored deployment is not simulated again.

    Attributes:
        store: file of the stored results.
        options: command-line options, such as seeds and numbers of agents.
        known_feasible: number of visited states that are checked for a satisfying plan.
        driven: number of new deployments.
        kept: number of deployments whose result was already stored.
        results: results of all deployments, in order.
    """

    store: ResultStore
    options: DeploymentOptions
    known_feasible: int = 0
    driven: int = 0
    kept: int = 0
    results: list[Result] = field(default_factory=list)
    _viable: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    def add(self, folder: RunDir, scenarios: Sequence[str], guards: Sequence[str]) -> None:
        """Simulate the policy of the run `folder` with each guard in each scenario, and append the results.

        Raises:
            RunError, SystemFileError: the run is damaged, or a world (simulated environment) fails.
        """
        for scenario in scenarios:
            run = Run.open(folder.path, scenario=None if scenario == NOMINAL else scenario)
            setting = self.options.setting(run, self.known_feasible)
            for guard in guards:
                self._add(key_of(run, scenario, guard, setting), run, guard, setting)

    def _add(self, key: Key, run: Run, guard: str, setting: Setting) -> None:
        driven = self.driven

        def deploy() -> Result:
            say(f"deploying {key.name}")
            self.driven += 1
            return self._deploy(run, guard, setting)

        result = self.store.get(key, deploy)
        self.results.append(result)
        self.kept += self.driven == driven
        say(f"{key.name}  {'kept' if self.driven == driven else format(result['seconds'], '.0f') + ' s'}")

    def _deploy(self, run: Run, name: str, setting: Setting) -> Result:
        """Simulate the policy of a run with the guard called `name`, and return its metrics."""
        begin = perf_counter()
        kind, asked = guard_of(name)
        margin = asked.of(run.task, run.policy, kind.name, setting.replan)
        guard = Guard(run.task, run.policy, kind.name, limits=Limits(seconds=setting.limit, margin=margin))
        recording = recorded(guard, setting)
        seconds = perf_counter() - begin
        known = self.viable(run.task, torch.from_numpy(recording.states[:, 0]))
        executed = judge_executed(run.task, recording, viable=known.numpy())
        metrics = measure(recording, executed, feasible_states(run.task, recording, setting.known_feasible))
        return {
            "run": run.dir.name,
            "policy": _policy_of(run.dir),
            **({"margin": dict(margin)} if margin else {}),
            "metrics": {name: plain(metrics[name]) for name in METRICS if name in metrics},
            "progress": {name: plain(metrics[name]) for name in filter(is_progress, metrics)},
            "acted": 1.0 - decided(recording)["policy"],
            "seconds": seconds,
        }

    def viable(self, task: Task, x0: Tensor) -> Tensor:
        """Return for each initial state whether a search finds a safe plan from there: booleans, (rows,).

        The result is cached for each set of initial states `x0`, (rows, n).
        """
        for known, found in self._viable:
            if known.shape == x0.shape and bool((known == x0).all()):
                return found
        found = viable(task, x0)
        self._viable.append((x0, found))
        return found


def key_of(run: Run, scenario: str, guard: str, setting: Setting) -> Key:
    """Return the key under which a deployment is stored: its name and all its inputs."""
    folder, decl = run.dir.path, run.task.system.decl
    world, laid = decl.test.world, decl.scenario
    kind, asked = guard_of(guard)
    limit = setting.limit if kind.intervenes and kind.timed else None
    errors = laid.errors if laid is not None and laid.errors != ErrorsDecl() else None
    spec, system, policy = (
        sha256((folder / name).read_text(encoding="utf-8"))
        for name in (RunDir.SPEC, RunDir.SYSTEM, "ckpt/last.json")
    )
    name = run.task.compiled.name
    return Key(
        f"{name}-{scenario.replace(' ', '_')}-{guard}",
        {
            **{"spec": name, "spec_sha256": spec, "system_sha256": system, "policy_sha256": policy},
            "world_sha256": None if world is None else sha256(world.path.read_text(encoding="utf-8")),
            **{"guard": guard, "guard_version": kind.version, "margin_share": asked.share},
            **{"scenario": scenario, "errors": None if errors is None else str(errors)},
            **{"seeds": list(setting.seeds), "agents": setting.agents, "steps": setting.steps},
            **{"replan": setting.replan, "time_limit": limit},
            "ceiling": setting.known_feasible,
        },
    )


def _policy_of(folder: RunDir) -> dict[str, Any]:
    """Return facts about the policy of a run: training method, seed, training time and held-out accuracy."""
    record = folder.record()
    result = record.get("result") or {}
    return {
        "method": (record.get("engine") or {}).get("method"),
        "seed": record.get("seed"),
        **{name: result.get(name) for name in ("accuracy", "seconds")},
    }


@dataclass(frozen=True, slots=True)
class DeploymentRow:
    """Results of one policy in one scenario.

    Attributes:
        spec: name of the specification.
        scenario: name of the scenario.
        seeds: number of seeds, that is, of deployments.
        agents: number of agents in each deployment.
        steps: number of steps of each deployment.
        guards: name of a guard -> result of the deployments with this guard.
    """

    spec: str
    scenario: str
    seeds: int
    agents: int
    steps: int
    guards: Mapping[str, Result]

    def metric(self, guard: str, name: str) -> Mapping[str, Any] | None:
        """Return mean and interval of the metric `name` with a guard.

        The result is None if the guard was not simulated, or if the metric is undefined.
        """
        found: Mapping[str, Any] | None = (self.guards.get(guard) or {}).get("metrics", {}).get(name)
        return found

    @property
    def size(self) -> str:
        """Size of the simulations as text: seeds x agents x steps."""
        return f"{self.seeds} x {self.agents} x {self.steps}"


def rows_of(results: Iterable[Result]) -> list[DeploymentRow]:
    """Group results into rows, one per specification, scenario and size, and sort the rows.

    Specifications come in the order of the paper, then others; scenarios come in the order of `SCENARIOS`.
    """
    groups: dict[tuple[str, str, int, int, int], dict[str, Result]] = {}
    for each in results:
        key = each["key"]
        group = (key["spec"], key["scenario"], len(key["seeds"]), int(key["agents"]), int(key["steps"]))
        groups.setdefault(group, {})[key["guard"]] = each
    return sorted((DeploymentRow(*key, guards) for key, guards in groups.items()), key=_place)


def _place(row: DeploymentRow) -> tuple[Any, ...]:
    scenario = SCENARIOS.index(row.scenario) if row.scenario in SCENARIOS else len(SCENARIOS)
    return *benchmark_order(row.spec), scenario, row.scenario, row.seeds, row.agents, row.steps


def policy_lines(rows: Iterable[DeploymentRow]) -> list[str]:
    """Return Markdown bullets with the training method, the training time and the accuracy of each policy."""
    lines = []
    for result in (each for row in rows for each in row.guards.values()):
        known = result["policy"]
        accuracy, seconds = (
            f"{known[name]:.{digits}f}" if known[name] is not None else "?"
            for name, digits in (("accuracy", 3), ("seconds", 0))
        )
        lines.append(
            f"- {result['key']['spec']}: run {result['run']}, method {known['method'] or '?'}, seed "
            f"{known['seed']}, {seconds} s of training, plan accuracy {accuracy} on held-out starts"
        )
    return list(dict.fromkeys(lines))


def publish_deployments(
    what: str,
    deployments: Deployments,
    output: Output,
    section: Callable[[Sequence[Result]], list[str]],
    table: Callable[[Sequence[DeploymentRow]], Table[Any, Any]],
) -> None:
    """Write all stored deployments into the documentation page, and print the requested ones.

    Args:
        what: name of the table.
        deployments: the requested deployments, with their results.
        output: the page, and whether JSON is printed.
        section: function that returns the text of the page for given results.
        table: function that returns the printed table for given rows.
    """
    rows = rows_of(deployments.results)
    shown = listed(what, rows, {}) if output.as_json else table(rows)
    counts = {"driven": deployments.driven, "kept": deployments.kept}
    everything = [*deployments.store.all().values()]
    publish(what, output, lambda: section(everything), {"rows": shown}, **counts)


def mean_and_half(metric: Mapping[str, Any] | None) -> str:
    """Return a mean and the half-width of its interval as text: `.957 ± .012`.

    Without an interval, only the mean is shown. If `metric` is None, the result is "".
    """
    if metric is None:
        return ""
    mean, high = float(metric["mean"]), metric["high"]
    text = f"{mean:.3f}" if high is None else f"{mean:.3f} ± {float(high) - mean:.3f}"
    return " ".join(part.removeprefix("0") if part.startswith("0.") else part for part in text.split(" "))
