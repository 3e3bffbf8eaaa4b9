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

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.executed import model_consistent
from stlc.controller.guard.feasibility import safety_task, solve

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
    safety = {rule.name for rule in task.compiled.safety}
    foreseen = model_consistent(task, recording)
    if recording.eventless is not None:
        foreseen &= recording.eventless
    unsafe = [each for each in broken if safety.intersection(each.rules)]
    others = [each for each in broken if each not in unsafe]
    found: dict[int, Cause] = {}
    for drives, asked, good in (
        (unsafe, safety_task(task) if unsafe else task, recording.safe),
        (others, task, recording.rho >= -TOLERANCE),
    ):
        if drives:
            found |= _causes(asked, recording, drives, good, foreseen, enough)
    return found


def _causes(
    asked: Task,
    recording: DeploymentRecording,
    drives: Sequence[Broken],
    good: NDArray[np.bool_],
    foreseen: NDArray[np.bool_],
    enough: Stop,
) -> dict[int, Cause]:
    """Find why drives failed that violated the specification of `asked`.

    Args:
        asked: the task whose specification plans had to satisfy.
        recording: the recorded drives.
        drives: the failed drives.
        good: mask of the samples at which a satisfying plan was followed, (rows, steps).
        foreseen: mask of the steps in which the world did what the model predicts, (rows, steps).
        enough: condition that ends the search early.
    """
    dt, little = asked.system.dt, NEAR * asked.system.decl.objective.gamma
    rows = [each.row for each in drives]
    times = [[time for time in each.rules.values() if time is not None] for each in drives]
    lasts = [min(round(min(each, default=0.0) / dt), recording.steps - 1) for each in times]
    since = []
    for row, last in zip(rows, lasts, strict=True):
        followed = np.flatnonzero(good[row, : last + 1])
        since.append(int(followed[-1]) + 1 if len(followed) else 0)
    states = torch.from_numpy(recording.states[rows, since])
    rho = solve(asked, states, passes=PASSES, tries=TRIES, stop=enough).rho.tolist()
    found: dict[int, Cause] = {}
    for row, start, last, best in zip(rows, since, lasts, rho, strict=True):
        if enough() and not np.isfinite(best):  # not searched for
            continue
        own = float(recording.policy_rho[row, start : last + 1].max(initial=-np.inf))
        if start > last and foreseen[row, : last + 1].all():
            found[row] = "rules"
        elif start and not foreseen[row, start - 1]:
            found[row] = "told"
        elif best >= -TOLERANCE:
            found[row] = "missed"
        elif max(best, own) > -little:
            found[row] = "near"
        else:
            found[row] = "later" if start else "start"
    return found
