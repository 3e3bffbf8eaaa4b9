"""Causes of failed drives: what became of the plans before a requirement was violated.

A drive is the closed-loop run of one agent. It follows a good plan for some time. From some sample on it
follows none, and later a requirement is violated. A search for good plans from there on tells the cause.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import torch

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.executed import model_consistent
from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import solve
from stlc.native import Stop, never

if TYPE_CHECKING:
    from stlc.controller.deployment.simulator import DeploymentRecording
    from stlc.controller.evaluation.rules import Broken

Cause: TypeAlias = Literal["start", "told", "later", "missed", "near", "rules"]
"""Cause of a failed drive.

- `start`: no good plan is known, even at the start.
- `told`: a good plan was known until the world did what its model does not foresee; for example, an obstacle
  came into view.
- `later`: a good plan was known until an instant before which the world did what the model foresees: plans
  end too early to see what comes.
- `missed`: a good plan was known, but another plan was followed.
- `near`: the best known plans miss the specification by little (`NEAR`).
- `rules`: good plans were followed until the violation; the rules of the drives ask for more.
"""
TRIES, PASSES = 4000, 2
"""Plans tried from a state in a pass of the search, and number of passes."""
LOOKS = 8
"""Number of instants, from the last good plan to the violation, at which plans are searched for."""
NEAR = 0.1
"""Robustness below 0 that counts as little, as a share of gamma, the margin that plans should have."""


@dataclass(frozen=True, slots=True)
class Lost:
    """Loss of a drive that violates a rule: since when no good plan was known, and why.

    If the drive violates a rule tagged `@safety`, a plan is good if it satisfies the requirements tagged
    `@safety`. Otherwise a plan is good if it satisfies the whole specification of the plans. A good plan is
    known at an instant if the followed plan is good, or if a search finds a good plan.

    Attributes:
        why: cause of the loss.
        time: instant from which on no good plan was known, in seconds from the start; for `missed`, the last
            instant at which one was known; for `rules`, that of the violation.
        inconsistent: whether a step was not model-consistent when the last good plan was lost.
    """

    why: Cause
    time: float
    inconsistent: bool = False


def losses(
    task: Task,
    recording: DeploymentRecording,
    broken: Sequence[Broken],
    safety: Collection[str],
    stop: Stop = never,
) -> dict[int, Lost]:
    """Find why drives failed.

    Args:
        task: specification of the plans, and system.
        recording: the recorded drives.
        broken: the drives whose cause is wanted.
        safety: names of the rules tagged `@safety`. The first rule that a drive violated counts; if it
            violated some of these, the first of these.
        stop: condition that ends the searches early.

    Returns:
        Row of a drive -> its loss. Drives whose cause cannot be determined are left out, and those for which
        the search was ended too early.
    """
    consistent = model_consistent(task, recording) if recording.eventless is None else recording.eventless
    little, dt = NEAR * task.system.decl.objective.gamma, task.system.dt
    found: dict[int, Lost] = {}
    for each in broken:
        row, unsafe = each.row, any(name in safety for name in each.rules)
        good = (
            recording.safe[row]
            if unsafe
            else TOLERANCE.satisfied(torch.from_numpy(recording.rho[row])).numpy()
        )
        times = [time for name, time in each.rules.items() if not unsafe or name in safety]
        located = [time for time in times if time is not None]
        last = min(round(min(located) / dt), recording.steps) if located else 0
        followed = np.flatnonzero(good[: last + 1])
        since = int(followed[-1]) + 1 if len(followed) else 0
        if since > last:
            if located and consistent[row, :last].all():
                found[row] = Lost("rules", dt * last)
            continue
        at = np.unique(np.linspace(since, last, min(LOOKS, last - since + 1)).round().astype(int))
        asked = task.safety_task if unsafe and task.compiled.safety else task
        states = torch.from_numpy(recording.states[row, at])
        plans = solve(asked, states, passes=PASSES, tries=TRIES, stop=stop)
        solved = np.flatnonzero(plans.solved.numpy())
        inconsistent = since > 0 and not consistent[row, since - 1]
        if len(solved):
            if located:
                found[row] = Lost("missed", dt * int(at[solved[-1]]), inconsistent)
        elif not stop() or bool(torch.isfinite(plans.rho).all()):
            own = float(recording.policy_rho[row, since : last + 1].max(initial=-np.inf))
            why: Cause = "told" if inconsistent else "later" if since else "start"
            if not inconsistent and max(float(plans.rho.max()), own) > -little:
                why = "near"
            found[row] = Lost(why, dt * since, inconsistent)
    return found
