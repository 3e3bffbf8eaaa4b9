"""Metrics of a deployment: definition, label, meaning and unit of each.

The terminal output, the report, the JSON files and the benchmark tables are derived from `METRICS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.evaluation.stats import MeanInterval

if TYPE_CHECKING:
    from stlc.controller.deployment.simulator import DeploymentRecording
    from stlc.controller.evaluation.executed import Executed

Mask: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Seed:
    """Results of one seed as masks.

    Masks of plans are (agents, steps). Masks of trajectories are (starts, agents): a start instant is one
    from which a whole planning window (the T steps of a plan) is recorded.

    Attributes:
        followed: whether the followed plan satisfies the specification.
        proposed: whether the policy's plan satisfies the specification.
        plan_safe: whether the followed plan satisfies the safety requirements.
        satisfied: whether the trajectory satisfies the specification from a start instant.
        safe: whether the trajectory satisfies the safety requirements from a start instant.
        satisfied_agents: (agents,), whether every requirement holds at all start instants.
        safe_agents: (agents,), whether every safety requirement holds at all start instants.
        viable: (agents,), whether the trajectory is safe, or a search finds a safe plan from its first state.
        consistent: whether the model predicts every step in the planning window from a start instant.
        eventless: whether no exogenous event occurs in the planning window; None if not recorded.
        searched: visited states whose feasibility was determined; None if there are none.
        feasible: visited states with a known satisfying plan; None if `searched` is None.
    """

    followed: Mask
    proposed: Mask
    plan_safe: Mask
    satisfied: Mask
    safe: Mask
    satisfied_agents: Mask
    safe_agents: Mask
    viable: Mask
    consistent: Mask
    eventless: Mask | None = None
    searched: Mask | None = None
    feasible: Mask | None = None

    @property
    def of_viable(self) -> Mask:
        """Mask, (starts, agents): True at all start instants of the viable agents, else False."""
        return np.broadcast_to(self.viable, self.safe.shape)


@dataclass(frozen=True, slots=True)
class Metric:
    """Metric: the share of plans (or of agents, or of start instants) that have a certain property.

    Attributes:
        key: name in JSON files.
        label: name in tables.
        meaning: explanation, a sentence without its full stop.
        mask: function from a seed to the mask of the plans, agents or instants with the property; it returns
            None if the property was not recorded.
        among: function from a seed to the mask of the population, in which the share is computed; None if the
            population consists of all plans, agents or instants. An empty population has no value.
        unit: unit of the value; shares have none.
        safety: whether the metric is omitted if no requirement is tagged `@safety`.
    """

    key: str
    label: str
    meaning: str
    mask: Callable[[Seed], Mask | None]
    among: Callable[[Seed], Mask | None] | None = None
    unit: str = ""
    safety: bool = False

    def of(self, seed: Seed) -> float:
        """Value of the metric for one seed.

        It is NaN if the population is empty or the property was not recorded.
        """
        mask = self.mask(seed)
        among = None if self.among is None else self.among(seed)
        if mask is None or (self.among is not None and among is None):
            return math.nan
        counted = mask if among is None else mask[among]
        return float(counted.mean()) if counted.size else math.nan


_ALL = (
    Metric(
        "plan_accuracy",
        "plan accuracy",
        "share of followed plans that satisfy the specification",
        lambda seed: seed.followed,
    ),
    Metric(
        "feasible",
        "feasible states",
        "share of visited states with a known satisfying plan: the followed one, or one that a search finds",
        lambda seed: seed.feasible,
        lambda seed: seed.searched,
    ),
    Metric(
        "feasible_followed",
        "plan accuracy, feasible states",
        "share of the feasible states whose followed plan satisfies the specification",
        lambda seed: seed.followed,
        lambda seed: seed.feasible,
    ),
    Metric(
        "policy_accuracy",
        "policy's plan accuracy",
        "share of the plans that the policy proposed which satisfy the specification",
        lambda seed: seed.proposed,
    ),
    Metric(
        "plan_safety",
        "plan safety",
        "share of followed plans that satisfy the requirements tagged @safety",
        lambda seed: seed.plan_safe,
        safety=True,
    ),
    Metric(
        "executed",
        "satisfied, agents",
        "share of agents whose drive satisfied the specification from every start",
        lambda seed: seed.satisfied_agents,
    ),
    Metric(
        "executed_safe",
        "safe, agents",
        "share of agents whose drive satisfied the requirements tagged @safety from every start",
        lambda seed: seed.safe_agents,
        safety=True,
    ),
    Metric(
        "savable",
        "viable, agents",
        "share of agents that were driven safely, or from whose start a search finds a safe plan",
        lambda seed: seed.viable,
        safety=True,
    ),
    Metric(
        "saved",
        "safe among viable, agents",
        "share of the viable agents that were driven safely",
        lambda seed: seed.safe_agents,
        lambda seed: seed.viable,
        safety=True,
    ),
    Metric(
        "saved_starts",
        "safe among viable, starts",
        "share of the starts of viable agents from which the drive satisfies the requirements tagged @safety",
        lambda seed: seed.safe,
        lambda seed: seed.of_viable,
        safety=True,
    ),
    Metric(
        "executed_starts",
        "satisfied, starts",
        "share of starts from which the drive satisfies the specification",
        lambda seed: seed.satisfied,
    ),
    Metric(
        "executed_safe_starts",
        "safe, starts",
        "share of starts from which the drive satisfies the requirements tagged @safety",
        lambda seed: seed.safe,
        safety=True,
    ),
    Metric(
        "foreseen",
        "model-consistent, starts",
        "share of starts from which the world did as the model says, through the window",
        lambda seed: seed.consistent,
    ),
    Metric(
        "foreseen_starts",
        "satisfied, model-consistent starts",
        "share of the model-consistent starts from which the drive satisfies the specification",
        lambda seed: seed.satisfied,
        lambda seed: seed.consistent,
    ),
    Metric(
        "foreseen_safe_starts",
        "safe, model-consistent starts",
        "share of the model-consistent starts from which the drive satisfies the requirements tagged @safety",
        lambda seed: seed.safe,
        lambda seed: seed.consistent,
        safety=True,
    ),
    Metric(
        "quiet",
        "no exogenous event, starts",
        "share of starts through whose window there was no exogenous event",
        lambda seed: seed.eventless,
    ),
    Metric(
        "quiet_safe_starts",
        "safe, starts without exogenous event",
        "share of those of viable agents from which the drive satisfies the requirements tagged @safety",
        lambda seed: seed.safe,
        lambda seed: None if seed.eventless is None else seed.eventless & seed.of_viable,
        safety=True,
    ),
)
METRICS = {metric.key: metric for metric in _ALL}
"""All metrics by key, in display order."""
HOLDS = "holds."
"""Prefix of the keys `holds.NAME`: share of start instants from which a run satisfies requirement NAME."""


def is_progress(key: str) -> bool:
    """True if `key` names progress that a world reports; False for a metric and for `holds.NAME`."""
    return key not in METRICS and not key.startswith(HOLDS)


def measure(
    recording: DeploymentRecording, executed: Executed, feasible: NDArray[np.float64] | None = None
) -> dict[str, MeanInterval]:
    """Compute means over seeds: of the metrics, the share per requirement, and the worlds' progress.

    The result maps the key of each value to its mean. If a metric is undefined for a seed, this seed is left
    out of the mean.

    Args:
        recording: trajectories and decisions.
        executed: verdicts on the trajectories.
        feasible: (rows, steps), 1 if a satisfying plan from the state is known, 0 if not, NaN if not
            searched.
    """
    rows = [slice(at, at + recording.agents) for at in range(0, len(recording.states), recording.agents)]
    each = [dict(_of_seed(recording, executed, feasible, own)) for own in rows]
    for found, progress in zip(each, recording.progress, strict=True):
        found |= {name: float(value) for name, value in progress.items()}
    values = {key: [one[key] for one in each if math.isfinite(one.get(key, math.nan))] for key in each[0]}
    return {key: MeanInterval.of(some) for key, some in values.items() if some}


def _of_seed(
    recording: DeploymentRecording, executed: Executed, feasible: NDArray[np.float64] | None, own: slice
) -> Iterator[tuple[str, float]]:
    names, safety = tuple(executed.rules), executed.safety
    seed = Seed(
        followed=TOLERANCE.satisfied(recording.rho[own]),
        proposed=TOLERANCE.satisfied(recording.policy_rho[own]),
        plan_safe=recording.safe[own],
        satisfied=executed.starts(names)[:, own],
        safe=executed.starts(safety)[:, own],
        satisfied_agents=executed.agents(names)[own],
        safe_agents=executed.agents(safety)[own],
        viable=executed.viable[own],
        consistent=executed.consistent[:, own],
        eventless=None if executed.eventless is None else executed.eventless[:, own],
        searched=None if feasible is None else np.isfinite(feasible[own]),
        feasible=None if feasible is None else feasible[own] == 1.0,
    )
    yield from ((key, metric.of(seed)) for key, metric in METRICS.items())
    for name, held in executed.rules.items():
        yield f"{HOLDS}{name}", float(held[:, own].mean()) if held[:, own].size else math.nan
