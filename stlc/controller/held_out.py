"""The last word on a policy: exact verdicts in float64 on states that training never drew from."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from stlc.controller.config import HELD_OUT, HELD_OUT_SEED
from stlc.controller.missions import visited
from stlc.controller.search import Searcher
from stlc.controller.task import satisfied
from stlc.files import write_atomic

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor

    from stlc.controller.policy import Mlp
    from stlc.controller.task import Task

CEILING_TRIES = 8000
"""Plans that are tried for a held-out state before it counts as infeasible."""


@dataclass(frozen=True, slots=True)
class Score:
    """How a policy does on held-out states.

    Attributes:
        accuracy: share whose plan satisfies the specification (rho >= -1e-6 in float64).
        interval: its 95 % Wilson interval.
        requirements: share per requirement.
        feasible: share for which some satisfying plan is known, the policy's or one that search found.
        states: (n, dim), float64.
        rho: (n,).
        each: (n, requirements).
        known: states for which some satisfying plan is known, (n,) bool.
    """

    accuracy: float
    interval: tuple[float, float]
    requirements: dict[str, float]
    feasible: float
    states: Tensor
    rho: Tensor
    each: Tensor
    known: Tensor

    def summary(self) -> dict[str, object]:
        """The plain numbers, for `run.json`."""
        return {
            "accuracy": self.accuracy,
            "interval": list(self.interval),
            "held_out": self.states.shape[0],
            "requirements": self.requirements,
            "feasible": self.feasible,
        }


def score(policy: Mlp, *, n: int = HELD_OUT, seed: int = HELD_OUT_SEED) -> Score:
    """Judge a policy on `n` held-out states of seed `seed`; of missions, on states along held-out ones."""
    task = policy.task
    if task.compiled.timers:
        states = visited(policy, n, seed)
    else:
        states = task.sample(n, seed=seed, dtype=torch.float64)
    plans, judged = policy.plan_judged(states)
    good = satisfied(judged.rho)
    shares = satisfied(judged.requirements).double().mean(0)
    failing = (~good).nonzero()[:, 0]
    known = good.clone()
    known[failing] = _solvable(task, states[failing], plans[failing], plans[good])
    accuracy = float(good.double().mean())
    return Score(
        accuracy=accuracy,
        interval=wilson(accuracy, n),
        requirements={rule.name: float(share) for rule, share in zip(task.rules, shares, strict=True)},
        feasible=float(known.double().mean()),
        states=states,
        rho=judged.rho,
        each=judged.requirements,
        known=known,
    )


def _solvable(task: Task, states: Tensor, plans: Tensor, bank: Tensor) -> Tensor:
    """Which of the failing states a search can solve, (k,) bool."""
    if states.shape[0] == 0:
        return torch.zeros(0, dtype=torch.bool)
    generator = torch.Generator().manual_seed(HELD_OUT_SEED + 1)
    searcher = Searcher(task, generator, enough=1e-4)
    found = searcher.repair(states.float(), plans.float(), bank.float(), tries=CEILING_TRIES)
    return found.solved


def wilson(share: float, n: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's score interval of a share of `n` trials (E. B. Wilson, 1927)."""
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)


def save_states(path: Path, task: Task, result: Score) -> None:
    """Keep the states and their verdicts, so that a picture can show where a policy fails."""
    meta = {"names": list(task.names), "requirements": [rule.name for rule in task.rules]}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        x0=result.states.numpy(),
        rho=result.rho.numpy(),
        requirements=result.each.numpy(),
        known=result.known.numpy(),
        meta=np.array(json.dumps(meta)),
    )
    path.parent.mkdir(exist_ok=True)
    write_atomic(path, buffer.getvalue())
