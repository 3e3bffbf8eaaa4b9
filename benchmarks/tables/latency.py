"""Latency of a decision for one agent on one thread, without a guard and with each.

States are taken from deployments under the paper's guard: half evenly from all visited states, half from
states with an intervention, which are rare for a good policy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.drives import GUARDS, recorded
from benchmarks.options import Output, RunsArgument, opened
from benchmarks.table import Table, measured_here, show, write_section
from benchmarks.timing import WARM, Times, one_thread
from stlc.cli.framework.options import SeedsOption
from stlc.cli.framework.program import command
from stlc.cli.framework.ranges import parse_seeds
from stlc.controller.deployment.simulator import DeploymentRecording, Setting
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.training.run import Run

TEXT = """## A decision

Written by `python -m benchmarks latency`. Milliseconds that one decision for one agent takes on one thread,
in states that are spread evenly over deployments under the paper's guard, and where the guard replaced the
policy's plan. `policy`: its plan, rollout and verdict. With a guard (also `none`): the verdict on the
previous plan as well, the choice where the world leaves one (of five stations), and what is tried instead.
"""
POLICY = "policy"
AGENTS = 5
_OUTPUT = Output()


@dataclass(frozen=True, slots=True)
class Row:
    """One policy under one guard.

    Attributes:
        benchmark: name of the specification.
        run: of the policy.
        guard: name; `policy` for the policy's plan, rollout and verdict alone.
        every: times in evenly chosen visited states.
        acting: times of decisions with an intervention of the guard; None without any.
    """

    benchmark: str
    run: str
    guard: str
    every: Times | None
    acting: Times | None


def _shown(which: str, name: str) -> Callable[[Row], str]:
    def shown(row: Row) -> str:
        times: Times | None = getattr(row, which)
        return "" if times is None else f"{getattr(times, name):.2f}"

    return shown


COLUMNS: dict[str, Callable[[Row], str]] = {
    "benchmark": lambda row: row.benchmark,
    "guard": lambda row: row.guard,
    "median": _shown("every", "median"),
    "99 %": _shown("every", "p99"),
    "where it acts: median": _shown("acting", "median"),
    "where it acts: 99 %": _shown("acting", "p99"),
    "decisions": lambda row: " / ".join(str(each.samples if each else 0) for each in (row.every, row.acting)),
}


@command(
    "python -m benchmarks latency",
    "python -m benchmarks latency runs/traffic/latest runs/ship_track/latest --page docs/benchmarks.md",
)
def latency(
    runs: RunsArgument = None,
    samples: Annotated[int, typer.Option("--samples", metavar="N", min=2, help="States a policy.")] = 600,
    seeds: SeedsOption = "100,101",
    output: Output = _OUTPUT,
) -> None:
    """Time decisions for one agent, without a guard and with each.

    Milliseconds on one thread, in states of deployments. The full guard has its default limit of 100 ms per
    decision.
    """
    rows = (
        row for folder in opened(runs) for row in rows_of(Run.open(folder.path), samples, parse_seeds(seeds))
    )
    told = lambda row: f"{row.benchmark}, {row.guard}: {COLUMNS['median'](row)} ms"  # noqa: E731
    table = Table("latency", rows, lambda row: row, COLUMNS, told)
    with one_thread():
        table.rows  # noqa: B018 - measured here
    if output.page is not None:
        write_section(output.page, "latency", [TEXT, *table.markdown(), "", measured_here()])
    show("latency", {"rows": table}, as_json=output.as_json)


def rows_of(run: Run, samples: int, seeds: tuple[int, ...]) -> Iterator[Row]:
    """The rows: the policy alone, then every guard."""
    task, test = run.task, run.task.system.decl.test
    guards = {mode: Guard(task, run.policy, mode, limits=Limits()) for mode in GUARDS}
    setting = Setting(seeds, min(AGENTS, test.agents), test.steps, test.replan)
    recording = recorded(guards["paper"], setting)
    even, acted = picked(recording, samples)
    yield Row(task.compiled.name, run.dir.name, POLICY, Times.of(_alone(run, recording, even)), None)
    for mode, guard in guards.items():
        every, there = _timed(guard, recording, even), _timed(guard, recording, acted)
        acting = [seconds for seconds, source in (*every, *there) if source]
        times = Times.of([seconds for seconds, _ in every])
        yield Row(task.compiled.name, run.dir.name, mode, times, Times.of(acting))


def picked(recording: DeploymentRecording, samples: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (row, step) of states: evenly chosen ones, (k, 2), and ones with an intervention, (l, 2)."""
    half = max(samples // 2, 1)
    every = np.argwhere(np.ones_like(recording.source, dtype=bool))
    return _spread(every, half), _spread(np.argwhere(recording.source > 0), half)


def _spread(places: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    found: NDArray[np.int64] = places[np.linspace(0, len(places) - 1, min(count, len(places))).astype(int)]
    return found


def _alone(run: Run, recording: DeploymentRecording, places: NDArray[np.int64]) -> list[float]:
    """Seconds of a plan of the policy, its rollout and its verdict."""
    found = []
    for row, step in (*places[:WARM], *places):
        x = torch.from_numpy(recording.states[row, step])[None]
        begin = perf_counter()
        run.plan_judged(x)
        found.append(perf_counter() - begin)
    return found[min(WARM, len(places)) :]


def _timed(
    guard: Guard, recording: DeploymentRecording, places: NDArray[np.int64]
) -> list[tuple[float, int]]:
    """Seconds and source of each decision. The first few are repeated, as they warm the caches."""
    found = []
    for row, step in (*places[:WARM], *places):
        before, now = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        begun = guard.decide(before).later()
        begin = perf_counter()
        if recording.options is not None:
            guard.prefer(torch.from_numpy(recording.options[row, step])[None], begun)
        decision = guard.decide(now, begun)
        found.append((perf_counter() - begin, int(decision.source)))
    return found[min(WARM, len(places)) :]
