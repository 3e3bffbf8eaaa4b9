"""Planning in closed loop, without training: a planner searches for a plan whenever the policy is called."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from stlc.controller.run.config import ResolvedConfig
from stlc.controller.search.planner_policy import PlannerChoice, PlannerPolicy, planner_of, planner_policy
from stlc.controller.training.config import TrainConfig, base_config
from stlc.controller.training.method import Method
from stlc.diagnostics import RunError
from stlc.registry import PLANNERS

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.rundir import RunDir


@dataclass(frozen=True, slots=True)
class PlanConfig(ResolvedConfig):
    """Options of a run that plans instead of training.

    Attributes:
        planner: name of the planner.
        options: JSON object with the options of the planner, name -> text.
        seconds: processor time per plan, in seconds.
        evaluations: maximum number of plans that the planner judges in one search; 0 for no limit.
    """

    planner: str = PLANNERS.default
    options: str = "{}"
    seconds: float = 0.02
    evaluations: int = 0


class PlanMethod(Method):
    """Receding-horizon planning without a trained policy: `stlc simulate SPEC --method search`."""

    options = PlanConfig

    def resolve(self, task: Task, config: TrainConfig) -> PlanConfig:
        """Determine the options; the options of the planner are taken from `config.planner`."""
        found = base_config(task, config, kind=PlanConfig)
        asked = config.planner
        if asked is None:
            return found
        planner_of(asked.name, asked.options)
        return replace(
            found,
            planner=asked.name,
            options=json.dumps(dict(asked.options)),
            seconds=asked.seconds,
            evaluations=asked.evaluations or 0,
        )

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> PlannerPolicy:  # noqa: ARG002
        """Return the planner as a policy.

        Raises:
            UsageError: U101, the planner cannot plan for the task.
            RunError: R101, the stored options are damaged.
        """
        assert isinstance(config, PlanConfig)
        try:
            given = {str(name): str(value) for name, value in json.loads(config.options).items()}
        except (ValueError, AttributeError, RecursionError) as error:
            message = f"the options of the planner of `{run.shown}` are damaged"
            raise RunError.of("R101", message, note=(str(error),)) from error
        choice = PlannerChoice(config.planner, given, config.seconds, config.evaluations or None)
        return planner_policy(task, choice, seed=config.seed)


METHOD = PlanMethod()
