"""Method of Meng and Fan (2023, Eq. 6 to 10): gradient descent on smooth robustness."""

from __future__ import annotations

from dataclasses import replace

from stlc.controller.problem.task import Task
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.training.config import TrainConfig, base_config
from stlc.controller.training.learner import NetworkMethod, Trainer
from stlc.controller.training.objective import Objective, paper_objective


class Gradient(NetworkMethod):
    """Gradient descent on smooth robustness; the network proposes one plan per state, without search.

    Minima and maxima are smoothed by log-sum-exp; jumps and conditions of the system, by tanh.
    """

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """Determine the options.

        As in Meng and Fan (2023), every step uses newly drawn states. With `train: {samples: N}` in the
        system file, a fixed training set of N states is used instead.
        """
        found = base_config(task, config, kind=self.options, batch=512)
        return replace(found, performance=1.0, samples=task.system.decl.train.samples or 0)

    def objective(self, learner: Trainer) -> Objective:
        """Objective of Meng and Fan (2023), whose margin gamma is set in the system file."""
        return paper_objective(learner.task)


METHOD = Gradient()
