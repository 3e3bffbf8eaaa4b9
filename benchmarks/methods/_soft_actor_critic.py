"""Soft actor-critic (Haarnoja et al., arXiv 1812.05905), for methods that learn a model of the system.

The method supplies the transitions; this module makes the gradient steps. All random numbers come from the
caller's generator, and a checkpoint holds the whole state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.methods._actor import optimizer_tensors, restore_optimizer
from benchmarks.methods._ensemble import BatchedMlp
from stlc.controller.run.checkpoint import below

if TYPE_CHECKING:
    from collections.abc import Mapping

LOG_LOW, LOG_HIGH = -5.0, 2.0
"""Bounds on the logarithm of the standard deviation of an action before squashing."""


BOUND = 10.0
"""Bound on normalised observations."""


@dataclass(frozen=True, slots=True)
class TransitionBatch:
    """B transitions; each is one step of an episode.

    Attributes:
        seen: observations before the step, (B, k).
        actions: actions, scaled from the control ranges to [-1, 1], (B, m).
        rewards: rewards of the step, (B,).
        after: observations after the step, (B, k).
        ended: 1 if the episode ended with the step, else 0, (B,).
    """

    seen: Tensor
    actions: Tensor
    rewards: Tensor
    after: Tensor
    ended: Tensor

    def of(self, rows: Tensor) -> TransitionBatch:
        """The transitions with the indices `rows`, (b,)."""
        parts = (self.seen, self.actions, self.rewards, self.after, self.ended)
        return TransitionBatch(*(part[rows] for part in parts))

    def joined(self, other: TransitionBatch) -> TransitionBatch:
        """These transitions, followed by those of `other`."""
        names = ("seen", "actions", "rewards", "after", "ended")
        return TransitionBatch(*(torch.cat((getattr(self, name), getattr(other, name))) for name in names))


@dataclass(frozen=True, slots=True)
class SacOptions:
    """Options of the training of actor and critics.

    Attributes:
        lr: learning rate of Adam for actor, critics and temperature.
        discount: discount factor of the return.
        average: share by which the target critics move towards the critics in a gradient step (tau).
        temperature: weight of the entropy; 0: the weight is learnt such that the entropy becomes -1 per
            control.
    """

    lr: float
    discount: float
    average: float
    temperature: float


class SoftActorCritic(nn.Module):
    """Actor and two critics of soft actor-critic.

    The actor's actions are Gaussian, squashed by tanh to [-1, 1]. The two critics are one batched network.

    Attributes:
        actor: normalised observations -> means and logarithms of standard deviations before the tanh,
            (1, B, k) -> (1, B, 2m).
        critics: normalised observations and actions -> values, (2, B, k + m) -> (2, B, 1).
        targets: target critics, a copy that follows the critics slowly.
        temperature: logarithm of the weight of the entropy, ().
        centre: mean of the observations, (k,).
        spread: standard deviation of the observations, (k,).
        scale: number by which rewards are divided, ().
    """

    centre: Tensor
    spread: Tensor
    scale: Tensor

    def __init__(
        self, inputs: int, controls: int, *, width: int, options: SacOptions, generator: torch.Generator
    ) -> None:
        super().__init__()
        self._options, self._controls = options, controls
        hidden, relu = (width, width), functional.relu
        self.actor = BatchedMlp(1, [inputs, *hidden, 2 * controls], activation=relu, generator=generator)
        widths = [inputs + controls, *hidden, 1]
        self.critics = BatchedMlp(2, widths, activation=relu, generator=generator)
        self.targets = BatchedMlp(2, widths, activation=relu, generator=generator)
        self.targets.load_state_dict(self.critics.state_dict())
        self.targets.requires_grad_(False)
        start = options.temperature or 0.1
        self.temperature = nn.Parameter(torch.tensor(math.log(start)))
        self.register_buffer("centre", torch.zeros(inputs))
        self.register_buffer("spread", torch.ones(inputs))
        self.register_buffer("scale", torch.ones(()))
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=options.lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=options.lr, fused=True),
            "temperature": torch.optim.Adam([self.temperature], lr=options.lr),
        }

    def normalise(self, seen: Tensor, returns: Tensor) -> None:
        """Set the normalisation of observations and rewards.

        Args:
            seen: samples of observations, (N, k).
            returns: sums of the rewards of E episodes, (E,).
        """
        spread = seen.std(0)
        self.centre.copy_(seen.mean(0))
        self.spread.copy_(torch.where(spread > 1e-6, spread, torch.ones_like(spread)))
        self.scale.copy_(torch.nan_to_num(returns.std(), nan=1.0).clamp(min=1e-3))

    def forward(self, seen: Tensor) -> Tensor:
        """The most probable actions, from -1 to 1, for observations: (B, k) -> (B, m)."""
        return torch.tanh(self._parameters_of(self._normalised(seen))[0])

    @torch.no_grad()
    def explore(self, seen: Tensor, generator: torch.Generator) -> Tensor:
        """Draw actions, from -1 to 1, from the actor's distribution for observations: (B, k) -> (B, m)."""
        return self._sampled(self._normalised(seen), generator)[0]

    def learn(self, batch: TransitionBatch, generator: torch.Generator) -> Tensor:
        """Make one gradient step of critics, actor and temperature; return the loss of the critics, ().

        The losses are those of Equations 5, 7 and 18 of Haarnoja et al. Each critic values an action; the
        smaller of the two values is used.
        """
        seen, after = self._normalised(batch.seen), self._normalised(batch.after)
        weight = self.temperature.detach().exp()
        with torch.no_grad():
            later, density = self._sampled(after, generator)
            value = self._values(self.targets, after, later).amin(0) - weight * density
            goal = batch.rewards / self.scale + self._options.discount * (1.0 - batch.ended) * value
        loss = (self._values(self.critics, seen, batch.actions) - goal).square().mean(1).sum()
        self._stepped("critics", loss)
        actions, density = self._sampled(seen, generator)
        self.critics.requires_grad_(False)
        self._stepped("actor", (weight * density - self._values(self.critics, seen, actions).amin(0)).mean())
        self.critics.requires_grad_(True)
        if not self._options.temperature:
            self._stepped("temperature", self.temperature * (self._controls - density.detach()).mean())
        with torch.no_grad():
            following: list[Tensor] = list(self.targets.parameters())
            torch._foreach_lerp_(following, list(self.critics.parameters()), self._options.average)
        return loss.detach()

    def _stepped(self, name: str, loss: Tensor) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    def _normalised(self, seen: Tensor) -> Tensor:
        return ((seen - self.centre) / self.spread).clamp(-BOUND, BOUND)

    def _parameters_of(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of the actions before the tanh, (B, m) each.

        `seen` are normalised observations, (B, k).
        """
        mean, log = self.actor(seen[None])[0].chunk(2, -1)
        return mean, LOG_LOW + 0.5 * (LOG_HIGH - LOG_LOW) * (torch.tanh(log) + 1.0)

    def _sampled(self, seen: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw random actions for normalised observations (Haarnoja et al., Appendix C).

        Returns:
            Actions, (B, m), and the logarithms of their probability densities, (B,).
        """
        mean, log = self._parameters_of(seen)
        noise = torch.randn(mean.shape, generator=generator)
        raw = mean + noise * log.exp()
        normal = -0.5 * noise.square() - log - 0.5 * math.log(2.0 * math.pi)
        squashed = 2.0 * (math.log(2.0) - raw - functional.softplus(-2.0 * raw))  # log(1 - tanh(raw)^2)
        return torch.tanh(raw), (normal - squashed).sum(-1)

    def _values(self, critics: BatchedMlp, seen: Tensor, actions: Tensor) -> Tensor:
        """Values that the two critics give to normalised observations (B, k) and actions (B, m): (2, B)."""
        values: Tensor = critics(torch.cat((seen, actions), -1).expand(2, -1, -1))[..., 0]
        return values

    def tensors(self) -> dict[str, Tensor]:
        """All weights and the states of the optimisers, under names that begin with `sac.`."""
        found = {f"sac.weights.{name}": value for name, value in self.state_dict().items()}
        for name, optimizer in self.optimizers.items():
            found |= optimizer_tensors(optimizer, f"sac.{name}")
        return found

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore weights and optimisers from `tensors`, which the method of this name returned."""
        self.load_state_dict(below(tensors, "sac.weights"))
        for name, optimizer in self.optimizers.items():
            restore_optimizer(optimizer, below(tensors, f"sac.{name}"))
