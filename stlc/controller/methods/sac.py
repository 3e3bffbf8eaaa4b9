"""Soft actor-critic (Haarnoja et al., ICML 2018) by stable-baselines3, which only the training needs.

The paper's RL_R, RL_S and RL_A are `--reward task`, `robustness` and `accuracy`. Extra `stlc[rl]`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from stlc.controller.methods import Learner, Method
from stlc.controller.methods._actor import ActorConfig, ActorPolicy
from stlc.controller.training.checkpoint import load_checkpoint, restoring, weights
from stlc.controller.training.config import base_config
from stlc.controller.training.run import spec_hash, trained_on
from stlc.diagnostics import Diagnostic, MissingError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.controller.parallel.ddp import Ranks
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import ResolvedConfig, TrainConfig
    from stlc.rundir import RunDir

BATCH, RATE = 256, 3e-4
"""Default transitions of an update, and learning rate: those of the library."""
EVERY = 10
"""Steps between validations."""


@dataclass(frozen=True, slots=True)
class SacConfig(ActorConfig):
    """Options of SAC; the paper has 8 environments, 1 update, and 5 to 20 million transitions.

    Attributes:
        updates: gradient steps after each step of all environments.
        capacity: of the replay buffer, in transitions.
        warmup_transitions: transitions with random controls before the first update.
        discount: gamma of the return.
        smoothing: share of the new critics in the target critics, per update.
    """

    updates: int = 4
    capacity: int = 1_000_000
    warmup_transitions: int = 100
    discount: float = 0.99
    smoothing: float = 0.005


class SacActor(nn.Module):
    """The mean of the library's actor, with the names of its weights; needs no package.

    Attributes:
        centre: mean of the observations of initial states, (k,).
        spread: their standard deviation, (k,).
    """

    centre: Tensor
    spread: Tensor
    middle: Tensor
    extent: Tensor

    def __init__(self, task: Task, hidden: Sequence[int]) -> None:
        super().__init__()
        system = task.system
        width, outputs = system.observed_count + 1, len(system.control_names)
        layers: list[nn.Module] = []
        for inputs, wide in pairwise((width, *hidden)):
            layers += [nn.Linear(inputs, wide), nn.ReLU()]
        self.latent_pi = nn.Sequential(*layers)
        self.mu = nn.Linear(hidden[-1], outputs)
        self.register_buffer("centre", torch.zeros(width))
        self.register_buffer("spread", torch.ones(width))
        self.register_buffer("middle", 0.5 * (system.control_low + system.control_high).float())
        self.register_buffer("extent", 0.5 * (system.control_high - system.control_low).float())

    def normalised(self, observation: Tensor) -> Tensor:
        """Observations on a common scale, (B, k)."""
        return (observation - self.centre) / self.spread

    def controls(self, scaled: Tensor) -> Tensor:
        """Controls in physical units of those in [-1, 1]: (B, m) -> (B, m)."""
        return self.middle + self.extent * scaled

    def forward(self, observation: Tensor) -> Tensor:
        """The most probable controls: (B, k) -> (B, m)."""
        mean: Tensor = self.mu(self.latent_pi(self.normalised(observation)))
        return self.controls(torch.tanh(mean))


class Sac(Method):
    """Soft actor-critic; one step of the training is one episode in every environment."""

    options = SacConfig

    def resolve(self, task: Task, config: TrainConfig) -> SacConfig:
        """Options of SAC; `--batch` is the number of transitions of an update."""
        found = base_config(task, config, kind=SacConfig, batch=BATCH)
        assert isinstance(found, SacConfig)
        lr = config.lr or task.system.decl.train.lr or RATE
        return replace(found, plans=1, share=0.0, lr=lr, every=EVERY)

    def learner(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks
    ) -> Learner:
        """Training state before the first step.

        Raises:
            MissingError: R301, stable-baselines3 is not installed.
            UsageError: U101, the reward is not declared, or several processes are to train together.
        """
        try:
            from stlc.controller.methods._sb3 import SacLearner
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in ("stable_baselines3", "gymnasium"):
                raise
            finding = Diagnostic(
                "R301", "method `sac` needs stable-baselines3", help=("pip install 'stlc[rl]'",)
            )
            raise MissingError(finding) from None
        assert isinstance(config, SacConfig)
        return SacLearner(task, config, steps=steps, device=device, ranks=ranks)

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> ActorPolicy:
        """The actor of a run."""
        saved = load_checkpoint(run, spec_hash=spec_hash(run), system_hash=trained_on(run))
        actor = SacActor(task, config.hidden)
        with restoring(run):
            actor.load_state_dict(weights(saved, "policy"))
        return ActorPolicy(task, actor.to(torch.device(device)).eval())


METHOD = Sac()
