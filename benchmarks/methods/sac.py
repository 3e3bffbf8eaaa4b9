"""Soft actor-critic (Haarnoja et al., ICML 2018) by stable-baselines3.

RL_R, RL_S and RL_A of Meng and Fan (2023) are this method with `reward=task`, `robustness` and `accuracy`.
Training needs stable-baselines3, which the extra `bench` installs; the trained policy does not.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from benchmarks.methods._actor import ActorPolicy
from benchmarks.methods._sac import SacActor, SacConfig
from stlc.controller.run.run import load_weights
from stlc.controller.training.config import base_config
from stlc.controller.training.method import Learner, Method
from stlc.extras import explained

if TYPE_CHECKING:
    from stlc.controller.parallel.ddp import Ranks
    from stlc.controller.problem.task import Task
    from stlc.controller.run.config import ResolvedConfig
    from stlc.controller.training.config import TrainConfig
    from stlc.rundir import RunDir

BATCH, RATE = 256, 3e-4
"""Default transitions of an update, and learning rate: those of the library."""
EVERY = 10
"""Steps between validations."""


class Sac(Method):
    """Soft actor-critic; one step of the training is one episode in every environment."""

    options = SacConfig
    extendable = True  # no step depends on the planned number of steps

    def resolve(self, task: Task, config: TrainConfig) -> SacConfig:
        """Determine the options; `--batch` is the number of transitions of a gradient step."""
        found = base_config(task, config, kind=SacConfig, batch=BATCH, rate=RATE)
        return replace(found, plans=1, share=0.0, every=EVERY)

    def learner(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks
    ) -> Learner:
        """Make the learner, in its state before the first step.

        Raises:
            MissingError: R301, stable-baselines3 is not installed.
            UsageError: U101, no reward is named `config.reward`; or this name is `task`, and the system
                declares no reward; or several processes are to train together.
        """
        with explained():
            from benchmarks.methods._sb3 import SacLearner
        assert isinstance(config, SacConfig)
        return SacLearner(task, config, steps=steps, device=device, ranks=ranks)

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> ActorPolicy:
        """Load the actor of a run as a policy."""
        actor = load_weights(run, SacActor(task, config.hidden), "policy")
        return ActorPolicy(task, actor.to(torch.device(device)).eval())


METHOD = Sac()
