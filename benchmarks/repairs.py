"""Repair methods for rejected plans, run one agent at a time in states of a deployment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import process_time
from typing import TypeAlias

import torch
from torch import Tensor

from benchmarks.deployments import sampled_states
from benchmarks.timing import Times, after_warm_up
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.candidates import TO_SPARE, Limits
from stlc.controller.guard.feasibility import solvable, viable
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.search import StagedSearch
from stlc.controller.guard.stages.gradient_refine import SEED, GradientAscent
from stlc.controller.problem.task import Task
from stlc.controller.training.local_search import Searcher
from stlc.controller.training.run import Run

SHORT, LONG = 2000, 32_000
"""Evaluations of a local search for each of its two initial guesses."""

Rejected: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""A state (1, n), and its rejected plans (1, T, m): the policy's and the previous one."""
Method: TypeAlias = Callable[[Tensor, Tensor, Tensor], Tensor]
"""`Rejected` -> plans (k, T, m)."""


@dataclass(frozen=True, slots=True)
class Mended:
    """Success of one repair method in the rejected states of one deployment.

    Attributes:
        benchmark: name of the specification.
        scenario: of the system; empty for the nominal system.
        way: name of the method.
        states: number of states.
        solvable: states with a plan for phi, found by any of the methods or a search.
        mended: solvable states solved by this method.
        savable: viable states, with a plan for phi_safe.
        saved: viable states for which this method finds such a plan.
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


def repairs(run: Run, samples: int, seeds: tuple[int, ...], scenario: str = "") -> Iterator[Mended]:
    """The success of every repair method in the same rejected states of a deployment."""
    task, states = run.task, _rejected(run, samples, seeds)
    if not states:
        return
    methods = methods_of(task, StagedSearch(task, run.policy, "full", limits=Limits(seconds=None)))
    tried = {name: _tried(task, method, states) for name, method in methods.items()}
    x = torch.cat([state for state, _, _ in states])
    can, safely = solvable(task, x), viable(task, x)
    for met, safe, _ in tried.values():
        can, safely = can | met, safely | safe
    for name, (met, safe, times) in tried.items():
        counts = int(can.sum()), int(met.sum()), int(safely.sum()), int(safe.sum())
        yield Mended(task.compiled.name, scenario, name, len(states), *counts, times)


def methods_of(task: Task, backup: StagedSearch) -> dict[str, Method]:
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


def _rejected(run: Run, samples: int, seeds: tuple[int, ...]) -> list[Rejected]:
    """States with an intervention in which both the policy's and the previous plan violate."""
    task, guard = run.task, Guard(run.task, run.policy, "paper")
    recording, _, acted = sampled_states(guard, seeds, 2 * samples)
    found = []
    for row, step in acted:
        before, x = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        plan, rest = run.policy.plan(x).to(x.dtype).detach(), guard.decide(before).later().plan
        if bool((task.judge(x.expand(2, -1), torch.cat((plan, rest))).rho < -TOLERANCE).all()):
            found.append((x, plan, rest))
    return found


def _tried(task: Task, method: Method, states: list[Rejected]) -> tuple[Tensor, Tensor, Times | None]:
    """Masks of the states for which a method finds a plan for phi, and for phi_safe; and its times."""

    def attempt(state: Rejected) -> tuple[bool, bool, float]:
        begin = process_time()
        plans = method(*state)
        seconds = process_time() - begin
        judged = task.judge(state[0].expand(len(plans), -1), plans, states=False)
        return bool((judged.rho >= -TOLERANCE).any()), bool((judged.safe >= -TOLERANCE).any()), seconds

    met, safe, seconds = zip(*after_warm_up(attempt, states), strict=True)
    return torch.tensor(met), torch.tensor(safe), Times.of(seconds)
