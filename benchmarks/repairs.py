"""Methods that repair rejected plans, compared in the same states of a deployment, one agent at a time.

A deployment is a closed-loop simulation. Its guard rejects plans that violate the specification.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import process_time
from typing import TypeAlias

import torch
from torch import Tensor

from benchmarks.deployments import sampled_states
from benchmarks.timing import Times, after_warm_up
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.candidates import TARGET_SHARE, Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kinds.full import GUARD as FULL
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.search import StagedSearch
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.search.ascent import SEED, GradientAscent
from stlc.controller.search.feasibility import solvable, viable
from stlc.controller.search.local_search import Searcher

SHORT, LONG = 2000, 32_000
"""Number of plans that a short and a long local search evaluate for each of two initial guesses."""

Rejected: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""A state (1, n), and its rejected plans (1, T, m): the policy's and the previous one."""
Method: TypeAlias = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Function that maps the three parts of `Rejected` to plans (k, T, m)."""


@dataclass(frozen=True, slots=True)
class Mended:
    """Success of one repair method in the states of one deployment in which plans were rejected.

    Attributes:
        benchmark: name of the specification.
        scenario: scenario of the system; "" for the system without a scenario.
        way: name of the repair method.
        states: number of states.
        solvable: number of states with a satisfying plan, found by any of the methods or by a search.
        mended: number of these states for which this method finds a satisfying plan.
        savable: number of states with a plan that satisfies the requirements tagged `@safety`.
        saved: number of these states for which this method finds such a plan.
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
    """Yield the success of every repair method in the same states, in which plans were rejected.

    Args:
        run: run of the policy.
        samples: greatest number of states.
        seeds: seeds of the deployment (closed-loop simulation) from which the states are taken.
        scenario: name of the scenario, for the results.
    """
    task, states = run.task, _rejected(run, samples, seeds)
    if not states:
        return
    methods = methods_of(task, StagedSearch(task, run.policy, FULL, limits=Limits(seconds=None)))
    tried = {name: _tried(task, method, states) for name, method in methods.items()}
    x = torch.cat([state for state, _, _ in states])
    can, safely = solvable(task, x), viable(task, x)
    for met, safe, _ in tried.values():
        can, safely = can | met, safely | safe
    for name, (met, safe, times) in tried.items():
        counts = int(can.sum()), int(met.sum()), int(safely.sum()), int(safe.sum())
        yield Mended(task.compiled.name, scenario, name, len(states), *counts, times)


def methods_of(task: Task, backup: StagedSearch) -> dict[str, Method]:
    """Return the repair methods: name -> function.

    `backup` is the search of the full guard, which is one of the methods.
    """
    target = TARGET_SHARE * task.system.decl.objective.gamma
    ascent = GradientAscent(task, torch.Generator().manual_seed(SEED), target=target)
    searcher = Searcher(task, torch.Generator().manual_seed(SEED), target=target)

    def local_search(x: Tensor, guesses: Tensor, tries: int) -> Tensor:
        return searcher.repair(x.expand(len(guesses), -1), guesses, tries=tries, threads=1).plans

    def steps_and_search(x: Tensor, plan: Tensor, rest: Tensor) -> Tensor:
        refined = ascent.refine(x, torch.stack((plan, rest), 1))[0]
        if float(task.judge(x, refined[:1], states=False).rho) >= target:
            return refined
        return torch.cat((refined, local_search(x, refined, SHORT)))

    return {
        "gradient steps": lambda x, plan, rest: ascent.refine(x, torch.stack((plan, rest), 1))[0],
        "local search": lambda x, plan, rest: local_search(x, torch.cat((plan, rest)), SHORT),
        "long local search": lambda x, plan, rest: local_search(x, torch.cat((plan, rest)), LONG),
        "steps, then search": steps_and_search,
        "full guard": lambda x, plan, rest: backup.search(x, plan, rest).plans,
    }


def _rejected(run: Run, samples: int, seeds: tuple[int, ...]) -> list[Rejected]:
    """Return states in which the guard intervened, and both the policy's plan and the previous plan fail."""
    task, guard = run.task, Guard(run.task, run.policy, PAPER.name)
    recording, _, acted = sampled_states(guard, seeds, 2 * samples)
    found = []
    for row, step in acted:
        before, x = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        plan, rest = run.policy.plan(x).to(x.dtype).detach(), guard.decide(before).later().plan
        if bool(TOLERANCE.violated(task.judge(x.expand(2, -1), torch.cat((plan, rest))).rho).all()):
            found.append((x, plan, rest))
    return found


def _tried(task: Task, method: Method, states: list[Rejected]) -> tuple[Tensor, Tensor, Times | None]:
    """Apply a repair method to all states.

    Returns:
        Whether it finds a satisfying plan, (states,); whether it finds a plan that satisfies the safety
        requirements, (states,); and its processor times.
    """

    def attempt(state: Rejected) -> tuple[bool, bool, float]:
        begin = process_time()
        plans = method(*state)
        seconds = process_time() - begin
        judged = task.judge(state[0].expand(len(plans), -1), plans, states=False)
        return (
            bool(TOLERANCE.satisfied(judged.rho).any()),
            bool(TOLERANCE.satisfied(judged.safe).any()),
            seconds,
        )

    met, safe, seconds = zip(*after_warm_up(attempt, states), strict=True)
    return torch.tensor(met), torch.tensor(safe), Times.of(seconds)
