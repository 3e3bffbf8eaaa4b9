"""Planning in closed loop, without training: a planner searches for a plan whenever the policy is called."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from stlc.controller.methods import Method
from stlc.controller.planning.planner import PlanBudget, PlannerPolicy, planner_named
from stlc.controller.training.config import ResolvedConfig, base_config
from stlc.registry import PLANNERS

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import TrainConfig
    from stlc.rundir import RunDir


@dataclass(frozen=True, slots=True)
class PlanConfig(ResolvedConfig):
    """Options of a run that plans instead of training.

    Attributes:
        planner: name of the planner.
        options: options of the planner, as `NAME=VALUE,NAME=VALUE`.
        seconds: processor time per plan.
        evaluations: maximum number of plans judged in search of one; 0 for no limit.
    """

    planner: str = PLANNERS.default
    options: str = ""
    seconds: float = 0.02
    evaluations: int = 0


class PlanMethod(Method):
    """Receding-horizon planning without a trained policy: `stlc simulate SPEC --method search`."""

    options = PlanConfig

    def resolve(self, task: Task, config: TrainConfig) -> PlanConfig:
        """Resolve the options; the options of the planner are taken from `config.planner`."""
        found = base_config(task, config, kind=PlanConfig)
        assert isinstance(found, PlanConfig)
        asked = config.planner
        if asked is None:
            return found
        options = ",".join(f"{name}={value}" for name, value in asked.options.items())
        planner_named(asked.name, **asked.options)
        return replace(
            found,
            planner=asked.name,
            options=options,
            seconds=asked.seconds,
            evaluations=asked.evaluations or 0,
        )

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> PlannerPolicy:  # noqa: ARG002
        """Return the planner as a policy.

        Raises:
            UsageError: U101, the planner cannot plan for the task.
        """
        assert isinstance(config, PlanConfig)
        given = dict(each.split("=", 1) for each in config.options.split(",") if each)
        planner = planner_named(config.planner, **given)
        budget = PlanBudget(config.seconds, config.evaluations or None)
        return PlannerPolicy(task, planner, budget, seed=config.seed)


METHOD = PlanMethod()
