"""Latency of a decision for one agent on one thread, without a guard and with each guard.

Decisions are timed in states that were visited in closed-loop simulations under the paper's guard. Half of
these states are chosen evenly from all visited ones. The others are states in which the guard intervened; a
good policy has few of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from time import process_time
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.deployments import sampled_states
from benchmarks.options import Output, RunsArgument, SeedsOption, opened
from benchmarks.table import Columns, Table, measured_here, publish
from benchmarks.timing import Times, after_warm_up, one_thread
from stlc.cli.framework.program import command
from stlc.controller.deployment.simulator import DeploymentRecording
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.run.run import Run
from stlc.diagnostics import UsageError
from stlc.options import parse_seeds
from stlc.registry import GUARDS

TEXT = """## A decision

Written by `python -m benchmarks latency`. Milliseconds that one decision for one agent takes on one thread,
in states that are spread evenly over deployments under the paper's guard, and where the guard replaced the
policy's plan. `policy`: its plan, rollout and verdict. A guard (also `none`) adds the verdict on the previous
plan, the choice among options if the world offers several (five stations), and the search for other plans.
`certified` adds the tube of the plan, and is left out where a system or specification has none.
"""
POLICY = "policy"
_OUTPUT = Output()


@dataclass(frozen=True, slots=True)
class LatencyRow:
    """Latency of the decisions of one policy with one guard.

    Attributes:
        benchmark: name of the specification.
        run: name of the policy's run.
        guard: name of the guard; `policy` if only the policy's plan, its rollout and its verdict are timed.
        every: times of decisions in states that are chosen evenly from all visited states.
        acting: times of decisions in which the guard intervened; None if there are none.
    """

    benchmark: str
    run: str
    guard: str
    every: Times | None
    acting: Times | None


COLUMNS: Columns[LatencyRow] = {
    **{"benchmark": "{benchmark}", "guard": "{guard}"},
    **{"median": "{every.median:.2f}", "99 %": "{every.p99:.2f}"},
    **{"where it acts: median": "{acting.median:.2f}", "where it acts: 99 %": "{acting.p99:.2f}"},
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
    """Time decisions for one agent, without a guard and with each guard.

    The table shows milliseconds on one thread, in states of closed-loop simulations. The full guard has its
    default time limit of 100 ms per decision.
    """
    opened_runs = (Run.open(folder.path) for folder in opened(runs))
    rows = (row for run in opened_runs for row in rows_of(run, samples, parse_seeds(seeds)))
    message = "{benchmark}, {guard}: {every.median:.2f} ms"
    table = Table("latency", rows, lambda row: row, COLUMNS, message)
    with one_thread():
        lines = lambda: [TEXT, *table.markdown(), "", measured_here()]  # noqa: E731
        publish("latency", output, lines, {"rows": table})


def rows_of(run: Run, samples: int, seeds: tuple[int, ...]) -> Iterator[LatencyRow]:
    """Yield the rows of a run: first the policy alone, then each guard.

    Args:
        run: run of the policy.
        samples: number of states in which decisions are timed.
        seeds: seeds of the closed-loop simulations from which the states are taken.
    """
    guards = dict(_guards(run))
    recording, even, acted = sampled_states(guards[PAPER.name], seeds, samples)

    def plan(index: NDArray[np.int64]) -> float:
        x = torch.from_numpy(recording.states[tuple(index)])[None]
        begin = process_time()
        run.plan_judged(x)
        return process_time() - begin

    names = run.task.compiled.name, run.dir.name
    yield LatencyRow(*names, POLICY, Times.of(after_warm_up(plan, [*even])), None)
    for mode, guard in guards.items():
        every, there = _timed(guard, recording, even), _timed(guard, recording, acted)
        acting = [seconds for seconds, source in (*every, *there) if source]
        yield LatencyRow(*names, mode, Times.of([seconds for seconds, _ in every]), Times.of(acting))


def _guards(run: Run) -> Iterator[tuple[str, Guard]]:
    """Yield the guards of a run by name, but not one that needs more than the run has."""
    for mode in GUARDS:
        try:
            yield mode, Guard(run.task, run.policy, mode, limits=Limits())
        except UsageError:
            if not GUARDS.get(mode).needs:
                raise


def _timed(
    guard: Guard, recording: DeploymentRecording, indices: NDArray[np.int64]
) -> list[tuple[float, int]]:
    """Return (seconds, source) of a decision in each state of the recording that `indices` selects.

    An index is a pair (row, step). The source is 0 for the policy, and greater than 0 for a stage of the
    guard.
    """

    def decide(index: NDArray[np.int64]) -> tuple[float, int]:
        row, step = index
        before, now = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        previous = guard.decide(before).later()
        begin = process_time()
        if recording.options is not None:
            guard.prefer(torch.from_numpy(recording.options[row, step])[None], previous)
        decision = guard.decide(now, previous)
        return process_time() - begin, int(decision.source)

    return after_warm_up(decide, [*indices])
