"""Repair of rejected plans: success rate and run time of each method.

Each method runs on the same states of a deployment under the paper's guard, one agent at a time: gradient
refinement, local search of two lengths, gradient refinement then local search as in plan repair, and the
whole guard.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from time import process_time
from typing import TYPE_CHECKING, Annotated

import torch
import typer
from torch import Tensor

from benchmarks.drives import recorded
from benchmarks.options import Output, RunsArgument, opened
from benchmarks.table import Table, measured_here, show, write_section
from benchmarks.tables.latency import AGENTS, picked
from benchmarks.timing import WARM, Times, one_thread
from stlc.cli.framework.options import SeedsOption
from stlc.cli.framework.program import command
from stlc.cli.framework.ranges import parse_seeds
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.deployment.simulator import Setting
from stlc.controller.guard.candidates import TO_SPARE, Limits
from stlc.controller.guard.feasibility import solvable, viable
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.search import StagedSearch
from stlc.controller.guard.stages.gradient_refine import SEED, GradientAscent
from stlc.controller.training.local_search import Searcher
from stlc.controller.training.run import Run

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

SHORT, LONG = 2000, 32_000
"""Evaluations of a local search for each of its two initial guesses."""

TEXT = """## Repair of a plan

Written by `python -m benchmarks repair`: states of deployments under the paper's guard in which neither the
policy's plan nor the previous one satisfies the specification. `repaired` are those for which a way finds a
plan that does, of those for which any way or a search finds one; `safe` the same for what is tagged
`@safety`. Milliseconds of processor time for one agent on one thread. A local search tries 2,000 plans from
each of the two, a long one 32,000.
"""
_OUTPUT = Output()

Way = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A state (1, n), the policy's plan and the previous plan, (1, T, m) each -> plans (k, T, m)."""


@dataclass(frozen=True, slots=True)
class Mended:
    """Success of one repair method in the rejected states of one deployment.

    Attributes:
        benchmark: name of the specification.
        scenario: of the system; empty for the nominal system.
        way: name of the method.
        states: number of states.
        solvable: states with a plan for phi, found by any of the methods or a search.
        mended: those of them solved by this method.
        savable: viable states, with a plan for phi_safe.
        saved: those of them for which this method finds one.
        times: processor time per state.
    """

    benchmark: str
    scenario: str
    way: str
    states: int
    solvable: int
    mended: int
    savable: int
    saved: int
    times: Times | None


COLUMNS: dict[str, Callable[[Mended], str]] = {
    "benchmark": lambda row: f"{row.benchmark}, {row.scenario}" if row.scenario else row.benchmark,
    "way": lambda row: row.way,
    "repaired": lambda row: f"{row.mended} of {row.solvable}",
    "safe": lambda row: f"{row.saved} of {row.savable}",
    "median": lambda row: "" if row.times is None else f"{row.times.median:.2f}",
    "99 %": lambda row: "" if row.times is None else f"{row.times.p99:.2f}",
}


@command(
    "python -m benchmarks repair",
    "python -m benchmarks repair runs/ship_track/latest --scenario shifted --page docs/benchmarks.md",
)
def repair(
    runs: RunsArgument = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            "--scenario", metavar="NAME", help="One to try besides the system as it is; repeatable."
        ),
    ] = None,
    samples: Annotated[int, typer.Option("--samples", metavar="N", min=1, help="States a policy.")] = 300,
    seeds: SeedsOption = "100,101",
    output: Output = _OUTPUT,
) -> None:
    """Count the rejected plans that each repair method repairs, and time it.

    Gradient refinement, local search, both, and the whole guard, on the same states of a deployment.
    """
    cells = product(opened(runs), ("", *(scenario or ())))
    rows = (
        row
        for folder, name in cells
        for run in [Run.open(folder.path, scenario=name or None)]
        for row in _rows(run, _rejected(run, samples, parse_seeds(seeds)), name)
    )
    told = lambda row: f"{row.benchmark}, {row.way}: {row.mended} of {row.solvable} repaired"  # noqa: E731
    table = Table("repair", rows, lambda row: row, COLUMNS, told)
    with one_thread():
        table.rows  # noqa: B018 - measured here
    if output.page is not None:
        write_section(output.page, "repair", [TEXT, *table.markdown(), "", measured_here()])
    show("repair", {"rows": table}, as_json=output.as_json)


def ways_of(task: Task, backup: StagedSearch) -> dict[str, Way]:
    """The repair methods by name."""
    enough = TO_SPARE * task.system.decl.objective.gamma
    ascent = GradientAscent(task, torch.Generator().manual_seed(SEED), enough=enough)
    searcher = Searcher(task, torch.Generator().manual_seed(SEED), enough=enough)

    def local_search(x: Tensor, places: Tensor, tries: int) -> Tensor:
        return searcher.at_once(x.expand(len(places), -1), places, tries=tries).plans

    def steps_and_search(x: Tensor, plan: Tensor, rest: Tensor) -> Tensor:
        raised = ascent.rise(x, torch.stack((plan, rest), 1))[0]
        if float(task.judge(x, raised[:1], states=False).rho) >= enough:
            return raised
        return torch.cat((raised, local_search(x, raised, SHORT)))

    return {
        "gradient steps": lambda x, plan, rest: ascent.rise(x, torch.stack((plan, rest), 1))[0],
        "local search": lambda x, plan, rest: local_search(x, torch.cat((plan, rest)), SHORT),
        "long local search": lambda x, plan, rest: local_search(x, torch.cat((plan, rest)), LONG),
        "steps, then search": steps_and_search,
        "full guard": lambda x, plan, rest: backup.search(x, plan, rest).plans,
    }


def _rejected(run: Run, samples: int, seeds: tuple[int, ...]) -> list[tuple[Tensor, Tensor, Tensor]]:
    """States with an intervention, and two rejected plans: the policy's and the previous one."""
    task, test = run.task, run.task.system.decl.test
    guard = Guard(task, run.policy, "paper")
    recording = recorded(guard, Setting(seeds, min(AGENTS, test.agents), test.steps, test.replan))
    found = []
    for row, step in picked(recording, 2 * samples)[1]:
        before, x = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        plan, rest = run.policy.plan(x).to(x.dtype).detach(), guard.decide(before).later().plan
        if bool((task.judge(x.expand(2, -1), torch.cat((plan, rest))).rho < -TOLERANCE).all()):
            found.append((x, plan, rest))
    return found


def _rows(run: Run, states: list[tuple[Tensor, Tensor, Tensor]], scenario: str) -> Iterator[Mended]:
    task = run.task
    ways = ways_of(task, StagedSearch(task, run.policy, "full", limits=Limits(seconds=None)))
    if not states:
        return
    verdicts = {name: _tried(task, way, states) for name, way in ways.items()}
    x = torch.cat([state for state, _, _ in states])
    can, safely = solvable(task, x), viable(task, x)
    for met, safe, _ in verdicts.values():
        can, safely = can | met, safely | safe
    for name, (met, safe, times) in verdicts.items():
        counts = (len(states), int(can.sum()), int(met.sum()), int(safely.sum()), int(safe.sum()))
        yield Mended(task.compiled.name, scenario, name, *counts, times)


def _tried(
    task: Task, way: Way, states: list[tuple[Tensor, Tensor, Tensor]]
) -> tuple[Tensor, Tensor, Times | None]:
    """Masks of the states for which a method finds a plan for phi, and for phi_safe; and its times."""
    met, safe, seconds = [], [], []
    for state in (*states[:WARM], *states):
        begin = process_time()
        plans = way(*state)
        seconds.append(process_time() - begin)
        judged = task.judge(state[0].expand(len(plans), -1), plans, states=False)
        met.append(bool((judged.rho >= -TOLERANCE).any()))
        safe.append(bool((judged.safe >= -TOLERANCE).any()))
    skip = min(WARM, len(states))
    return torch.tensor(met[skip:]), torch.tensor(safe[skip:]), Times.of(seconds[skip:])
