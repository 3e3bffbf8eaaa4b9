"""Options and actor of the method `sac`; only its training (`_sb3.py`) needs stable-baselines3."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from benchmarks.methods._actor import ActorConfig
from stlc.controller.policies.policy import ActorNetwork, DenseLayers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class SacConfig(ActorConfig):
    """Options of SAC. Meng and Fan (2023) use 8 environments, 1 update, and 5 to 20 million transitions.

    Attributes:
        updates: number of gradient steps after each step of all environments.
        capacity: capacity of the replay buffer, in transitions.
        warmup_transitions: number of transitions with random controls before the first update.
        discount: discount factor of the return.
        smoothing: share by which the target critics move towards the critics in an update (tau).
    """

    updates: int = 4
    capacity: int = 1_000_000
    warmup_transitions: int = 100
    discount: float = 0.99
    smoothing: float = 0.005


class SacActor(ActorNetwork):
    """Copy of the actor of stable-baselines3: a network from observations to the most probable controls.

    Its weights have the same names as those of the original actor, from which they are copied. The package
    stable-baselines3 is not needed to use this class.

    Attributes:
        centre: mean of the observations of initial states, (k,).
        spread: standard deviation of the observations of initial states, (k,).
    """

    squash = "tanh"
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

    @property
    def layers(self) -> DenseLayers:
        """Weights of the network."""
        normalisation = self.centre, self.spread
        return DenseLayers.of([*self.latent_pi, self.mu], normalisation=normalisation, activation="relu")

    def normalised(self, observation: Tensor) -> Tensor:
        """Observations minus their mean, divided by their standard deviation, (B, k)."""
        return (observation - self.centre) / self.spread

    def controls(self, scaled: Tensor) -> Tensor:
        """Scale controls from [-1, 1] to physical units: (B, m) -> (B, m)."""
        return self.middle + self.extent * scaled

    def forward(self, observation: Tensor) -> Tensor:
        """The most probable controls in physical units, for observations: (B, k) -> (B, m)."""
        mean: Tensor = self.mu(self.latent_pi(self.normalised(observation)))
        return self.controls(torch.tanh(mean))
