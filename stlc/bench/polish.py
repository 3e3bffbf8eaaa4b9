"""`stlc bench polish`: what mends the plans that the monitor rejects, and how long it takes.

Each way is tried on the same states of a deployment under the paper's guard, one agent at a time: gradient
steps, climbs of two lengths, gradient steps and then a climb as polishing does it, and the whole guard.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from time import process_time
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.bench.latency import AGENTS, WARM, Times, picked
from stlc.bench.measure import one_thread
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.deployment.simulator import Recorder, Setting, drive
from stlc.controller.guard.feasibility import savable, solvable
from stlc.controller.guard.gradient_refine import Ascent
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.plan_repair import SEED, TO_SPARE, FullBackup, Limits
from stlc.controller.training.local_search import Searcher
from stlc.controller.training.run import Run
from stlc.controller.world import world_type

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.rundir import RunDir

SHORT, LONG = 2000, 32_000
"""Plans that a climb tries for each of its two places."""

Way = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A state (1, n), the plan of the policy and what is left of the one before, (1, T, m) -> plans (k, T, m)."""


@dataclass(frozen=True, slots=True)
class Mended:
    """What one way came to in the rejected states of one deployment.

    Attributes:
        benchmark: name of the specification.
        scenario: of the system, empty for the system as it is.
        way: name of it.
        states: that were tried.
        solvable: how many of them have a plan for phi, as any of the ways or a search finds one.
        mended: how many of these this way found one for.
        savable: how many have a plan for phi_safe.
        saved: how many of these this way found one for.
        times: of one state, of the processor.
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


def mended_rows(
    folders: Iterable[RunDir], *, scenarios: Sequence[str], samples: int, seeds: Sequence[int]
) -> Iterator[Mended]:
    """Measure policies one after the other, a row for each way; the scenario "" is the system as it is."""
    with one_thread():
        for folder, scenario in product(folders, scenarios):
            run = Run.open(folder.path, scenario=scenario or None)
            yield from _rows(run, _rejected(run, samples, tuple(seeds)), scenario)


def ways_of(task: Task, backup: FullBackup) -> dict[str, Way]:
    """The ways by name."""
    enough = TO_SPARE * task.system.decl.objective.gamma
    ascent = Ascent(task, torch.Generator().manual_seed(SEED), enough=enough)
    searcher = Searcher(task, torch.Generator().manual_seed(SEED), enough=enough)

    def climb(x: Tensor, places: Tensor, tries: int) -> Tensor:
        return searcher.at_once(x.expand(len(places), -1), places, tries=tries).plans

    def steps_and_climb(x: Tensor, plan: Tensor, rest: Tensor) -> Tensor:
        raised = ascent.rise(x, torch.stack((plan, rest), 1))[0]
        if float(task.judge(x, raised[:1], states=False).rho) >= enough:
            return raised
        return torch.cat((raised, climb(x, raised, SHORT)))

    return {
        "gradient steps": lambda x, plan, rest: ascent.rise(x, torch.stack((plan, rest), 1))[0],
        "climb": lambda x, plan, rest: climb(x, torch.cat((plan, rest)), SHORT),
        "long climb": lambda x, plan, rest: climb(x, torch.cat((plan, rest)), LONG),
        "steps, then climb": steps_and_climb,
        "full guard": lambda x, plan, rest: backup.search(x, plan, rest).plan,
    }


def _rejected(run: Run, samples: int, seeds: tuple[int, ...]) -> list[tuple[Tensor, Tensor, Tensor]]:
    """States in which the guard acted and both plans are rejected: the policy's, and what was left of one."""
    task, test = run.task, run.task.system.decl.test
    guard = Guard(task, run.policy, "paper")
    recorder = Recorder(min(AGENTS, test.agents))
    setting = Setting(seeds, recorder.agents, test.steps, test.replan)
    drive(guard, world_type(task.system.decl), setting, recorder)
    recording = recorder.recording()
    assert recording is not None
    found = []
    for row, step in picked(recording, 2 * samples)[1]:
        before, x = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        plan, rest = run.policy.plan(x).to(x.dtype).detach(), guard.decide(before).later().plan
        if bool((task.judge(x.expand(2, -1), torch.cat((plan, rest))).rho < -TOLERANCE).all()):
            found.append((x, plan, rest))
    return found


def _rows(run: Run, states: list[tuple[Tensor, Tensor, Tensor]], scenario: str) -> Iterator[Mended]:
    task = run.task
    ways = ways_of(task, FullBackup(task, run.policy, limits=Limits(seconds=None)))
    if not states:
        return
    verdicts = {name: _tried(task, way, states) for name, way in ways.items()}
    x = torch.cat([state for state, _, _ in states])
    can, safely = solvable(task, x), savable(task, x)
    for met, safe, _ in verdicts.values():
        can, safely = can | met, safely | safe
    for name, (met, safe, times) in verdicts.items():
        counts = (len(states), int(can.sum()), int(met.sum()), int(safely.sum()), int(safe.sum()))
        yield Mended(task.compiled.name, scenario, name, *counts, times)


def _tried(
    task: Task, way: Way, states: list[tuple[Tensor, Tensor, Tensor]]
) -> tuple[Tensor, Tensor, Times | None]:
    """Where a way finds a plan for phi, where one for phi_safe, and how long it takes."""
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
