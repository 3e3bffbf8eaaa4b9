"""Plans from given initial states, in short, and what the errors of a scenario do to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from stlc.assurance.verification.tubes import DEVIATIONS, TubeModel
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.search.missed import BetterPlanner, Missed
from stlc.controller.search.planner import PlanResult
from stlc.jsontext import Num


@dataclass(frozen=True, slots=True)
class PlanRobustness:
    """Robustness of the best plans over all initial states."""

    least: Num
    median: Num
    greatest: Num


@dataclass(frozen=True, slots=True)
class PlanSeconds:
    """Processor time of a plan, in seconds."""

    mean: float
    median: float
    most: float


@dataclass(frozen=True, slots=True)
class GuaranteedRobustness:
    """Bounds on the robustness of a requirement over all initial states, and the plans that satisfy it."""

    low: Num
    high: Num
    guaranteed: int


@dataclass(frozen=True, slots=True)
class PlanTubes:
    """Bounds for all errors of a scenario; normal noise is bounded at a number of standard deviations.

    `numbers` are the numbers of the dynamics that may be wrong; constants in `exact` are not, as conditions
    or limits read them.
    """

    scenario: str
    deviations: float | None
    numbers: tuple[str, ...]
    exact: tuple[str, ...]
    guaranteed: int
    robustness: tuple[Num, Num]
    requirements: dict[str, GuaranteedRobustness]

    @classmethod
    def of(cls, model: TubeModel, result: PlanResult, scenario: str, start: Sequence[str]) -> PlanTubes:
        """Bound the robustness of plans; `start`: columns that follow from the others at the start."""
        found, loose = model.tube(result.states, result.plans, start=start), model.uncertain
        low, high = (model.task.graph.overall(each) for each in (found.low, found.high))
        each = zip(model.task.rules, found.low.unbind(1), found.high.unbind(1), strict=True)
        return cls(
            scenario,
            DEVIATIONS if model.truncated else None,
            () if loose is None else tuple(map(str, loose.numbers)),
            () if loose is None else tuple(loose.exact),
            int(TOLERANCE.satisfied(low).sum()),
            (float(low.min()), float(high.max())),
            {
                rule.name: GuaranteedRobustness(
                    float(least.min()), float(most.max()), int(TOLERANCE.satisfied(least).sum())
                )
                for rule, least, most in each
            },
        )


@dataclass(frozen=True, slots=True)
class Plans:
    """Plans from given initial states.

    Attributes:
        spec: name of the specification.
        system: name of the system.
        method: name of the planner.
        budget: processor time for an initial state at most, in seconds.
        starts: number of initial states.
        satisfied: number of plans that satisfy the specification.
        infeasible: number of initial states without a satisfying plan, proved.
        robustness: robustness of the plans.
        seconds: processor time of a plan.
        evaluations: mean number of judged plans.
        missed: requirements that the other plans violate.
        better: a planner that does better; None if none was found, or looked for.
        trace: file of the plans.
        tube: bounds for the errors of a scenario, if they were asked for.
    """

    JSON: ClassVar = (
        "spec system method budget starts satisfied infeasible robustness seconds evaluations missed better "
        "trace tube?"
    )

    spec: str
    system: str
    method: str
    budget: float
    starts: int
    satisfied: int
    infeasible: int
    robustness: PlanRobustness
    seconds: PlanSeconds
    evaluations: float
    missed: tuple[Missed, ...]
    better: BetterPlanner | None
    trace: str
    tube: PlanTubes | None = None
