"""Causes of failed drives: what became of the plans before a requirement was violated.

A drive follows a satisfying plan for some time. From some sample on it follows none, and later a requirement
is violated. The cause is told from that sample: whether a search finds a satisfying plan there, and whether
the world did at the step before what the model predicts. A drive is the closed-loop run of one agent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import torch

from stlc.controller.evaluation.executed import model_consistent
from stlc.controller.guard.feasibility import safety_task, solve
from stlc.controller.problem.task import satisfied

if TYPE_CHECKING:
    from stlc.controller.deployment.simulator import DeploymentRecording
    from stlc.controller.evaluation.rules import Broken
    from stlc.controller.problem.task import Task
    from stlc.native import Stop

Cause: TypeAlias = Literal["start", "told", "later", "missed", "near", "rules"]
"""Cause of a failed drive; the first four are those of `stlc.controller.evaluation.rules.Lost`.

- `start`: no satisfying plan is known from the start of the mission.
- `told`: a satisfying plan was followed, until the world did what its model does not foresee.
- `later`: a satisfying plan was followed, until one step later none was known, although the world did what
  the model foresees: plans end too early to see what comes.
- `missed`: a satisfying plan is known, and none was followed.
- `near`: the best known plans miss the specification by little (`NEAR`).
- `rules`: plans that satisfied their specification were followed to the end; the rules of the drives ask for
  more.
"""
TRIES, PASSES = 4000, 2
"""Plans tried from a state in a pass of the search, and number of passes."""
NEAR = 0.1
"""Robustness below 0 that counts as little, as a share of gamma, the margin that plans should have."""


def causes(
    task: Task, recording: DeploymentRecording, broken: Sequence[Broken], enough: Stop
) -> dict[int, Cause]:
    """Find why drives failed.

    Plans are asked for what the drive violated: the requirements tagged `@safety` if one of these is among
    them, else the whole specification.

    Args:
        task: specification of the plans, and system.
        recording: the recorded drives.
        broken: the drives whose cause is wanted.
        enough: condition that ends the searches early.

    Returns:
        Row of a drive -> cause; drives for which the search was ended too early are left out.
    """
    safety, dt = {rule.name for rule in task.compiled.safety}, task.system.dt
    little = NEAR * task.system.decl.objective.gamma
    foreseen = model_consistent(task, recording)
    if recording.eventless is not None:
        foreseen &= recording.eventless
    found: dict[int, Cause] = {}
    for unsafe in (True, False):
        drives = [each for each in broken if unsafe is not safety.isdisjoint(each.rules)]
        if not drives:
            continue
        asked = safety_task(task) if unsafe else task
        good = recording.safe if unsafe else satisfied(torch.from_numpy(recording.rho)).numpy()
        rows, lasts, since = [each.row for each in drives], [], []
        for each in drives:
            first = min((time for time in each.rules.values() if time is not None), default=0.0)
            lasts.append(min(round(first / dt), recording.steps - 1))
            followed = np.flatnonzero(good[each.row, : lasts[-1] + 1])
            since.append(int(followed[-1]) + 1 if len(followed) else 0)
        states = torch.from_numpy(recording.states[rows, since])
        plans = solve(asked, states, passes=PASSES, tries=TRIES, stop=enough)
        searched = zip(rows, since, lasts, plans.rho.tolist(), plans.solved.tolist(), strict=True)
        for row, start, last, best, solved in searched:
            own = float(recording.policy_rho[row, start : last + 1].max(initial=-np.inf))
            if enough() and not np.isfinite(best):  # not searched for
                continue
            if start > last and foreseen[row, : last + 1].all():
                found[row] = "rules"
            elif start and not foreseen[row, start - 1]:
                found[row] = "told"
            elif solved:
                found[row] = "missed"
            else:
                found[row] = "near" if max(best, own) > -little else "later" if start else "start"
    return found
