"""Final evaluation of a policy: exact verdicts in float64 on held-out states."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.run.config import HELD_OUT, HELD_OUT_SEED
from stlc.controller.search.feasibility import solve
from stlc.controller.search.planner import PlanBudget, plan
from stlc.files import File
from stlc.native import Stop, never

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from torch import Tensor

    from stlc.controller.policies.policy import Policy

KNOWN_FEASIBLE_TRIES = 8000
"""Plans tried for a held-out state before it counts as infeasible."""
MOST_SEARCHED = 1024
"""Maximum number of failing states to search; extrapolation has a standard error of 1.6 %."""
FEW, JUDGED = 4, 80_000
"""Number of failing states from which the planner `search` searches if no satisfying plan is known for any
state, and number of plans that it judges for each of them."""
CHUNK = 256
"""Batch size of the search."""
TORCH_CHUNK = 32
"""Batch size of the search in torch."""


@dataclass(frozen=True, slots=True)
class Score:
    """Result of a policy on held-out states (initial states that the training does not use).

    Attributes:
        accuracy: share of states whose plan satisfies the specification (rho >= -1e-6 in float64).
        interval: 95 % Wilson interval of the accuracy.
        requirements: share of states whose plan satisfies a requirement, for each requirement.
        feasible: share of states with a known satisfying plan, from the policy or from a search. If only a
            random sample of the failing states was searched, the share solved in this sample is assumed for
            the other failing states.
        states: the held-out states, (n, dim), float64.
        rho: robustness of each plan, (n,).
        each: robustness per requirement, (n, requirements).
        known: mask of the states with a known satisfying plan, (n,).
        searched: mask of the states that the policy solved or that were searched, (n,).
        endless: if the mission has no end, the time in seconds for which it was simulated; else None.
    """

    accuracy: float
    interval: tuple[float, float]
    requirements: dict[str, float]
    feasible: float
    states: Tensor
    rho: Tensor
    each: Tensor
    known: Tensor
    searched: Tensor
    endless: float | None = None

    def summary(self) -> dict[str, Any]:
        """The shares and counts as a JSON object for `run.json`."""
        return {
            "accuracy": self.accuracy,
            "interval": list(self.interval),
            "held_out": self.states.shape[0],
            "requirements": self.requirements,
            "feasible": self.feasible,
            "searched": int(self.searched.sum()),
            **({} if self.endless is None else {"judged_seconds": self.endless}),
        }


def silent(_text: str) -> None:
    """Discard a progress report."""


def score(
    task: Task,
    policy: Policy,
    *,
    n: int = HELD_OUT,
    seed: int = HELD_OUT_SEED,
    stop: Stop = never,
    report: Callable[[str], None] = silent,
) -> Score:
    """Judge a policy on held-out states (initial states that the training does not use).

    The states are starts of missions: what else a mission reaches depends on the policy itself. If the
    policy's plans fail from some states, a search looks for satisfying plans from at most `MOST_SEARCHED` of
    these states, chosen at random. The search starts from the policy's plan. If it finds none, a second
    search ignores the policy, because the feasible share should hardly depend on how well the policy is
    trained. The second search is made only with native code, as it is slow in torch.

    Args:
        task: specification and system.
        policy: policy to judge.
        n: number of held-out states.
        seed: seed of their random numbers.
        stop: function that returns True to end the evaluation early. If this happens while plans are
            judged, fewer than `n` states are judged. If it happens during the searches, the interrupted batch
            of states counts as not searched, except the first batch, which always counts as searched.
        report: function that receives the progress as a short text.
    """
    states = task.sample(n, seed=seed, dtype=torch.float64)
    states, plans, rho, each = _judged(policy, states, stop, report)
    n, good = len(states), TOLERANCE.satisfied(rho)
    shares = TOLERANCE.satisfied(each).double().mean(0)
    generator = torch.Generator().manual_seed(HELD_OUT_SEED + 1)
    failing = (~good).nonzero()[:, 0]
    failing = failing[torch.randperm(len(failing), generator=generator)]
    known, searched = good.clone(), good.clone()
    size = TORCH_CHUNK if task.native is None else CHUNK
    for number, chunk in enumerate(torch.split(failing[:MOST_SEARCHED], size)):
        if number and stop():
            break
        report(f"evaluation, search of {number * size:,} of {len(failing[:MOST_SEARCHED]):,} failing starts")
        given = states[chunk], plans[chunk], plans[good]
        found = solve(task, *given, 1, tries=KNOWN_FEASIBLE_TRIES, generator=generator, stop=stop).solved
        left = torch.nonzero(~found)[:, 0]
        if len(left) and task.native is not None and not stop():
            found[left] = TOLERANCE.satisfied(solve(task, states[chunk[left]], stop=stop).rho)
        if number and stop():
            break
        known[chunk], searched[chunk] = found, True
    if len(failing) and not bool(known.any()) and not stop():
        few = failing[:FEW]
        known[few] = plan(task, states[few], budget=PlanBudget(torch.inf, JUDGED, stop=stop)).satisfied
        searched |= known
    accuracy = float(good.double().mean())
    solved, tried = int(known[failing].sum()), int(searched[failing].sum())
    assumed = (len(failing) - tried) * solved / max(1, tried)  # as among those that were searched
    return Score(
        accuracy=accuracy,
        interval=wilson(accuracy, n),
        endless=None if task.compiled.recurring is None else task.mission_steps * task.system.dt,
        requirements={rule.name: float(share) for rule, share in zip(task.rules, shares, strict=True)},
        feasible=(int(known.sum()) + assumed) / n,
        states=states,
        rho=rho,
        each=each,
        known=known,
        searched=searched,
    )


def _judged(
    policy: Policy, states: Tensor, stop: Stop, report: Callable[[str], None]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Judge the policy's plans from batches of states; end early once `stop` returns True.

    At least one batch is judged.

    Returns:
        The judged states, (k, dim), their plans, (k, T, m), the robustness of the plans, (k,), and their
        robustness per requirement, (k, requirements).
    """
    plans: list[Tensor] = []
    rho: list[Tensor] = []
    each: list[Tensor] = []
    for part in torch.split(states, policy.judged_at_once):
        if rho and stop():
            break
        report(f"evaluation, {sum(map(len, rho)):,} of {len(states):,} held-out starts")
        followed, judged = policy.plan_judged(part)
        plans.append(followed)
        rho.append(judged.rho)
        each.append(judged.requirements)
    count = sum(map(len, rho))
    return states[:count], torch.cat(plans), torch.cat(rho), torch.cat(each)


def wilson(share: float, n: int) -> tuple[float, float]:
    """Wilson's score interval (low, high) of a share of successes in `n` trials, with a confidence of 95 %.

    Source: E. B. Wilson, 1927.
    """
    z = 1.96
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return 0.0 if share == 0.0 else max(0.0, middle - half), 1.0 if share == 1.0 else min(1.0, middle + half)


def save_states(path: Path, task: Task, result: Score) -> None:
    """Write the held-out states and their verdicts to the `.npz` file `path`, for pictures of failures."""
    meta = {"names": list(task.system.names), "requirements": [rule.name for rule in task.rules]}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        x0=result.states.numpy(),
        rho=result.rho.numpy(),
        requirements=result.each.numpy(),
        known=result.known.numpy(),
        searched=result.searched.numpy(),
        meta=np.array(json.dumps(meta)),
    )
    File(path).write(buffer.getvalue())
