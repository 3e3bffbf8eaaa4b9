"""Search for a plan in place of one that violates the specification, without torch.

This is the search of Meng and Fan (2023), on the ONNX graphs of an exported controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.runtime.decision import prefix_shooting
from stlc.runtime.facts import ControllerQuantity
from stlc.runtime.graphs import Graphs, JudgedPlans, Numbers, joined

POLICY, BACKUP, SAFEST = range(3)
"""Source of a plan: the policy, the backup policy, or the longest safe prefix."""


@dataclass(frozen=True, slots=True)
class Found:
    """Plan found for one state.

    `judged` is the plan with its verdicts, as one row. `source` is the rule that chose the plan, `BACKUP` or
    `SAFEST`. `t0` is the length of the prefix: the number of first actions of the plan that the search tried
    from a list, instead of letting the policy plan them.
    """

    judged: JudgedPlans
    source: int
    t0: int


def search(graphs: Graphs, x: Numbers, plan: Numbers, rest: Numbers | None = None) -> Found:
    """Search for a plan from a state in which the policy's plan violates the specification.

    Every plan that is tried begins with a prefix, a sequence of T0 actions from a list that is fixed in
    advance. The policy plans the rest. T0 grows until a plan satisfies the specification or at least its
    safety requirements. If no plan does, the plan that keeps the safety requirements longest is returned.

    Args:
        graphs: graphs of the controller.
        x: state, (n,).
        plan: plan of the policy, (T, m); entries that are not finite are replaced.
        rest: rest of the previous plan, extended to (T, m); None if there is no previous plan.

    Returns:
        The plan found, as one row.
    """
    own, grid = finite(plan, graphs.facts.controls), graphs.facts.grid
    previous = [] if rest is None else [graphs.judged(x[None], finite(rest, graphs.facts.controls)[None])[0]]

    def tried(length: int) -> Sequence[JudgedPlans]:
        return [joined([_candidates(graphs, x, own, length), *previous])]

    for shot in prefix_shooting(grid.lengths, tried, NUMPY):
        if shot.found or shot.last:
            source, falls = BACKUP, None
            if not shot.found:
                source, plans = SAFEST, shot.plans.plan
                size = max(grid.batch // graphs.facts.horizon, 1)
                parts = [plans[at : at + size] for at in range(0, len(plans), size)]
                falls = np.concatenate(
                    [graphs.falls(np.repeat(x[None], len(part), 0), part) for part in parts]
                ).T
            chosen = shot.chosen(falls)
            return Found(shot.plans.of([int(chosen.argmax())]), source, shot.length)
    return Found(graphs.judged(x[None], own[None])[0], SAFEST, 0)


def _candidates(graphs: Graphs, x: Numbers, own: Numbers, length: int) -> JudgedPlans:
    """All plans for the prefix length T0 = `length`, with verdicts, one per row.

    The first T0 steps of a plan are one of the prefixes to try; in the first row, they come from the policy's
    own plan `own`. The policy plans the other steps.
    """
    grid = graphs.facts.grid
    heads = np.concatenate((own[None, :length], grid.prefixes(length)))
    parts = []
    for first in range(0, len(heads), grid.batch):
        some = heads[first : first + grid.batch]
        starts = np.repeat(x[None], len(some), 0)
        plans = np.repeat(own[None], len(some), 0)
        plans[:, :length] = some
        reached = graphs.judged(starts, plans)[1]["states"][:, length]
        tail = finite(graphs.continued(reached), graphs.facts.controls)
        plans[:, length:] = tail[:, : own.shape[0] - length]
        parts.append(graphs.judged(starts, plans)[0])
    return joined(parts)


def finite(plans: Numbers, controls: Sequence[ControllerQuantity]) -> Numbers:
    """Replace each entry of plans (…, m) that is not finite by the admissible control value nearest to 0."""
    rest = [min(max(0.0, each.low or 0.0), each.high or 0.0) for each in controls]
    return np.where(np.isfinite(plans), plans, rest)
