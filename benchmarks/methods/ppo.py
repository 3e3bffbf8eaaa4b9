"""Proximal policy optimisation over batched episodes (Schulman et al., arXiv 1707.06347, 2017).

One step of the training plays one episode in every environment. Then it passes several times over the
transitions. The loss is the clipped surrogate objective (Eq. 7) with an entropy bonus. Advantages are those
of generalised advantage estimation (Schulman et al., arXiv 1506.02438, Eq. 16). Observations, returns and
advantages are normalised.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from benchmarks.methods._actor import (
    ActorConfig,
    ActorLearner,
    ActorPolicy,
    optimizer_tensors,
    restore_optimizer,
)
from stlc.controller.options import bounded
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.policies.policy import ActorNetwork, DenseLayers
from stlc.controller.problem.environments import Environments, Reward
from stlc.controller.run.checkpoint import below
from stlc.controller.run.run import load_weights
from stlc.controller.training.config import base_config
from stlc.controller.training.method import Method
from stlc.dynamics.model.controls import raw_width, squash

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.controller.problem.task import Task
    from stlc.controller.run.config import ResolvedConfig
    from stlc.controller.training.config import TrainConfig
    from stlc.rundir import RunDir

VALUE = 0.5
"""Weight of the error of the critic in the loss."""
ENVIRONMENTS = 512
"""Default number of environments."""
HIDDEN = (64, 64)
"""Widths of both networks."""
RATE = 1e-3
"""Default peak learning rate."""
EVERY = 10
"""Steps between validations."""
LEAST = 0.05
"""Share of the peak learning rate at the end of the training."""
MOST = 10.0
"""Bound on normalised observations."""
NARROW = 1e-4
"""Spread below which values are not scaled."""


@dataclass(frozen=True, slots=True)
class PpoConfig(ActorConfig):
    """Options of PPO.

    Attributes:
        epochs: number of passes over the transitions of a training step.
        minibatches: number of gradient steps in a pass.
        discount: discount factor of the return. By default 1: episodes are finite, and the policy observes
            their elapsed share.
        trace: lambda of the generalised advantage estimation.
        ratio: bound on the change of the probability ratio (epsilon of Schulman et al. 2017).
        entropy: weight of the entropy bonus.
        deviation: initial standard deviation of the controls before the tanh.
        correlation: correlation between the exploration noises of successive steps (Korenkevych et al., IJCAI
            2019). Uncorrelated noise averages out in states that integrate the controls.
    """

    environments: int = bounded(ENVIRONMENTS, 1, 65_536)
    epochs: int = bounded(5, 1, 10**6)
    minibatches: int = bounded(8, 1, 10**6)
    discount: float = bounded(1.0, 0, 1)
    trace: float = bounded(0.95, 0, 1)
    ratio: float = 0.2
    entropy: float = 0.005
    deviation: float = bounded(1.0, 1e-6, 1e3)
    correlation: float = bounded(0.8, 0, 1)


class Moments(nn.Module):
    """Running mean and standard deviation of vectors; 0 and 1 before the first vectors are added.

    Attributes:
        mean: mean, (k,) float32.
        spread: standard deviation, (k,) float32.
        sums: counts, sums and sums of squares, (3, k) float64.
    """

    mean: Tensor
    spread: Tensor
    sums: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("spread", torch.ones(width))
        self.register_buffer("sums", torch.zeros(3, width, dtype=torch.float64))

    @torch.no_grad()
    def add(self, vectors: Tensor, ranks: Ranks) -> None:
        """Update mean and standard deviation with vectors (B, k) of each rank (process).

        All ranks must call this at the same time.
        """
        found = vectors.double()
        sums = torch.stack((torch.full_like(found[0], len(found)), found.sum(0), found.square().sum(0)))
        if ranks.size > 1:
            means = torch.tensor(ranks.mean(sums.flatten().tolist()), dtype=torch.float64)
            sums = ranks.size * means.view_as(sums).to(sums)
        self.sums += sums
        count, total, squares = self.sums
        mean = total / count
        spread = (squares / count - mean.square()).clamp(min=0.0).sqrt()
        self.mean.copy_(mean)
        self.spread.copy_(torch.where(spread > NARROW, spread, torch.ones_like(spread)))


class ActorCritic(ActorNetwork):
    """Two separate networks of a normalised observation: a Gaussian policy and a value function.

    The policy network outputs w raw controls, unbounded numbers that are then squashed to the control ranges.

    Attributes:
        deviation: logarithm of the standard deviation of each raw control, (w,).
        observations: running mean and standard deviation of the observations, (k,).
        returns: running mean and standard deviation of the returns of episodes, (1,).
    """

    def __init__(self, task: Task, config: PpoConfig) -> None:
        super().__init__()
        self._task, self._correlation = task, config.correlation
        width, hidden = task.system.observed_count + 1, config.hidden
        outputs = raw_width(task.system.decl.controls)
        self.actor = _network([width, *hidden, outputs], last=0.01)
        self.critic = _network([width, *hidden, 1], last=1.0)
        self.deviation = nn.Parameter(torch.full((outputs,), math.log(config.deviation)))
        self.observations, self.returns = Moments(width), Moments(1)

    @property
    def layers(self) -> DenseLayers:
        """Weights of the policy network."""
        seen = self.observations
        normalisation = seen.mean, seen.spread
        return DenseLayers.of(list(self.actor), normalisation=normalisation, activation="tanh", bound=MOST)

    def normalised(self, observation: Tensor) -> Tensor:
        """Observations minus their running mean, divided by their standard deviation, (B, k)."""
        seen = self.observations
        return ((observation - seen.mean) / seen.spread).clamp(-MOST, MOST)

    def controls(self, raw: Tensor) -> Tensor:
        """Map raw controls into the control ranges: (B, w) -> (B, m)."""
        return squash(raw, self._task.system.decl.controls)

    def forward(self, observation: Tensor) -> Tensor:
        """The most probable controls in physical units, for observations: (B, k) -> (B, m)."""
        mean: Tensor = self.actor(self.normalised(observation))
        return self.controls(mean)

    def judged(self, seen: Tensor, noise: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Log probability density of the controls `raw`, and the critic's values of `seen`, (B,) each.

        Args:
            seen: normalised observations, (B, k).
            noise: exploration noise of the step before, in standard deviations, (B, w).
            raw: controls before squashing, (B, w).
        """
        values: Tensor = self.critic(seen)[:, 0]
        return self.density(self.actor(seen), noise, raw), values

    def drawn(self, noise: Tensor, white: Tensor) -> Tensor:
        """Exploration noise of a step, (B, w), in standard deviations.

        It is correlated with the noise of the step before.

        Args:
            noise: exploration noise of the step before, (B, w).
            white: independent standard normal numbers, (B, w).
        """
        return self._correlation * noise + math.sqrt(1.0 - self._correlation**2) * white

    def density(self, mean: Tensor, noise: Tensor, raw: Tensor) -> Tensor:
        """Logarithm of the probability density of raw controls: (B, w) each -> (B,).

        Args:
            mean: mean of the raw controls without noise.
            noise: exploration noise of the step before, in standard deviations.
            raw: the raw controls.
        """
        innovation = math.sqrt(1.0 - self._correlation**2)
        distance = (raw - mean) * torch.exp(-self.deviation) - self._correlation * noise
        whitened = (distance / innovation).square()
        constant = 0.5 * math.log(2.0 * math.pi) + math.log(innovation)
        return -(0.5 * whitened + self.deviation + constant).sum(-1)

    @property
    def entropy(self) -> Tensor:
        """Entropy of the raw controls up to a constant, (); it does not depend on the state."""
        return self.deviation.sum()


def _network(widths: Sequence[int], last: float) -> nn.Sequential:
    """Network with tanh between its layers and orthogonal initial weights.

    The initial weights of the last layer are scaled by `last`.
    """
    layers: list[nn.Module] = []
    for index, (inputs, outputs) in enumerate(pairwise(widths), start=2):
        layer = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(layer.weight, last if index == len(widths) else math.sqrt(2.0))
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


@dataclass(frozen=True, slots=True)
class EpisodeBatch:
    """Transitions of one episode in every environment.

    Attributes:
        seen: observations, (T, N, k).
        raw: controls before squashing, (T, N, w).
        noise: exploration noise of the step before, in standard deviations, (T, N, w); for the first step, a
            random draw.
        density: logarithm of the probability density of the controls, (T, N).
        rewards: rewards of the steps, (T, N).
    """

    seen: Tensor
    raw: Tensor
    noise: Tensor
    density: Tensor
    rewards: Tensor


class PpoLearner(ActorLearner):
    """Training of an actor by proximal policy optimisation (PPO).

    On one machine the same seed and number of steps give the same weights.
    """

    config: PpoConfig

    def __init__(
        self, task: Task, config: PpoConfig, *, steps: int, device: torch.device, ranks: Ranks = ALONE
    ) -> None:
        super().__init__(task, config, steps=steps, device=device, ranks=ranks)
        reward: Reward = config.reward  # type: ignore[assignment]
        self.environments = Environments(task, config.environments, reward=reward, generator=self.generator)
        self.network = network_of(task, config).to(device)
        ranks.agree_on(self.network)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=config.lr, eps=1e-5, fused=True)

    @property
    def policy(self) -> ActorPolicy:
        """Policy that applies the actor's most probable controls, without exploration noise, on the CPU."""
        on_processor = self.device.type == "cpu"
        return ActorPolicy(self.task, self.network if on_processor else deepcopy(self.network).cpu())

    @property
    def rate(self) -> float:
        """Learning rate of the next step; it falls linearly over the training."""
        left = 1.0 - self.step / max(self.steps, 1)
        return self.config.lr * max(left, LEAST)

    def advance(self) -> float:
        """Play one episode in every environment and learn from it.

        Returns:
            The mean loss; NaN if the loss or a gradient is not finite.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate
        episodes = self._played()
        with torch.no_grad():
            network, ranks = self.network, self.ranks
            seen = network.normalised(episodes.seen)
            network.returns.add(episodes.rewards.sum(0)[:, None], ranks)
            advantages, targets = self._estimated(seen, episodes.rewards / network.returns.spread)
        loss = self._learnt(replace(episodes, seen=seen), advantages.flatten(), targets.flatten())
        if not math.isfinite(loss):
            return math.nan
        network.observations.add(episodes.seen.flatten(0, 1), ranks)
        self.step += 1
        self.loss = loss
        return loss

    @torch.no_grad()
    def _played(self) -> EpisodeBatch:
        """Play one episode in every environment with controls drawn from the policy."""
        environments, network = self.environments, self.network
        seen, means, raws, rewards = [environments.reset().to(self.device)], [], [], []
        spread, noises = torch.exp(network.deviation), [self._noise()]
        for _ in range(environments.steps):
            means.append(network.actor(network.normalised(seen[-1])))
            noises.append(network.drawn(noises[-1], self._noise()))
            raws.append(means[-1] + spread * noises[-1])
            result = environments.step(network.controls(raws[-1]).cpu())
            rewards.append(result.reward.to(self.device))
            seen.append(result.observation.to(self.device))
        raw, noise = torch.stack(raws), torch.stack(noises[:-1])
        density = network.density(torch.stack(means), noise, raw)
        return EpisodeBatch(torch.stack(seen[:-1]), raw, noise, density, torch.stack(rewards))

    def _noise(self) -> Tensor:
        """Draw independent standard normal numbers for the raw controls of every environment, (N, w)."""
        shape = self.config.environments, len(self.network.deviation)
        return torch.randn(shape, generator=self.generator).to(self.device)

    def _estimated(self, seen: Tensor, rewards: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised advantages of the steps, and the values that the critic is to learn, (T, N) each.

        Args:
            seen: normalised observations, (T, N, k).
            rewards: rewards divided by the standard deviation of the returns, (T, N).
        """
        config, values = self.config, self.network.critic(seen)[..., 0]
        after = torch.cat((values[1:], torch.zeros_like(values[:1])))  # an episode ends for good
        errors = rewards + config.discount * after - values
        advantages = torch.zeros_like(errors)
        ahead = torch.zeros_like(errors[0])
        for step in reversed(range(len(errors))):
            ahead = errors[step] + config.discount * config.trace * ahead
            advantages[step] = ahead
        mean, spread = advantages.mean(), advantages.std()
        return (advantages - mean) / (spread + 1e-8), advantages + values

    def _learnt(self, episodes: EpisodeBatch, advantages: Tensor, targets: Tensor) -> float:
        """Make all gradient steps of one training step; stop early if a loss or gradient is not finite.

        Args:
            episodes: transitions, with normalised observations.
            advantages: normalised advantages, (T N,).
            targets: values that the critic is to learn, (T N,).

        Returns:
            The mean loss; NaN if a loss or gradient is not finite.
        """
        config, total = self.config, 0.0
        seen, raw, noise = (part.flatten(0, 1) for part in (episodes.seen, episodes.raw, episodes.noise))
        density = episodes.density.flatten()
        size = -(-len(seen) // config.minibatches)
        for _ in range(config.epochs):
            order = torch.randperm(len(seen), generator=self.generator).to(self.device)
            for rows in torch.split(order, size):
                now, values = self.network.judged(seen[rows], noise[rows], raw[rows])
                ratio, gain = torch.exp(now - density[rows]), advantages[rows]
                clipped = ratio.clamp(1.0 - config.ratio, 1.0 + config.ratio)
                loss = -torch.minimum(ratio * gain, clipped * gain).mean()
                loss = loss + VALUE * (values - targets[rows]).square().mean()
                loss = loss - config.entropy * self.network.entropy
                self.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                value = self.ranks.learn(self.network.parameters(), loss.detach())
                length = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.clip)
                if not bool(torch.isfinite(value + length)):
                    return math.nan
                self.optimizer.step()
                total += float(value)
        return total / (config.epochs * -(-len(seen) // size))

    def tensors(self) -> dict[str, Tensor]:
        """Tensors from which training resumes exactly: random numbers, network, optimiser.

        All ranks (processes that train together) must call this at the same time. The result on the first
        rank contains the random numbers of all ranks, and is stored in the checkpoint. The results on the
        other ranks contain only their own random numbers.
        """
        own = super().tensors()
        found = dict(own)
        for index, theirs in enumerate(self.ranks.gather(own), start=1):
            found |= {f"rank{index}.{name}": value for name, value in theirs.items()}
        found |= {f"network.{name}": value for name, value in self.network.state_dict().items()}
        return found | optimizer_tensors(self.optimizer, "adam")

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float | int]) -> None:
        own = {} if self.ranks.first else {"generator": tensors[f"rank{self.ranks.rank}.generator"]}
        super().restore(tensors | own, facts)
        self.network.load_state_dict(below(tensors, "network"))
        restore_optimizer(self.optimizer, below(tensors, "adam"))


class Ppo(Method):
    """Proximal policy optimisation with 512 episodes in parallel."""

    options = PpoConfig
    learns = PpoLearner

    def resolve(self, task: Task, config: TrainConfig) -> PpoConfig:
        """Determine the options; `--batch` sets the number of episodes that are simulated in parallel."""
        found = base_config(task, config, kind=PpoConfig, batch=ENVIRONMENTS, rate=RATE)
        return replace(found, hidden=HIDDEN, plans=1, every=EVERY, environments=found.batch)

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> ActorPolicy:
        """Load the actor of a run as a policy."""
        assert isinstance(config, PpoConfig)
        network = load_weights(run, network_of(task, config), "network")
        return ActorPolicy(task, network.to(torch.device(device)).eval())


def network_of(task: Task, config: PpoConfig) -> ActorCritic:
    """Make a network whose initial weights depend only on `config.seed`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return ActorCritic(task, config)


METHOD = Ppo()
