"""PETS: probabilistic ensembles with trajectory sampling (Chua et al., NeurIPS 2018).

An ensemble of networks learns the system from episodes. Whenever the policy is called, it searches for a plan
by the cross-entropy method: it samples control sequences and keeps the best. The value of a sequence is the
mean reward of several imagined episodes (particles), each predicted by one of the networks. By default a
search covers the whole plan, with controls that are constant over a few steps.

Meng and Fan (2023) compare with PETS under these settings: `reward=task`, and `ahead=5 piece=1
population=350 rounds=5 particles=20 model_lr=7.5e-4 model_decay=3e-5 model_held=0 model_epochs=25 growth=0
environments=10`. In closed-loop simulations they use `ahead=3 particles=3`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor

from benchmarks.methods._imagined import (
    LearntModel,
    ModelConfig,
    ModelLearner,
    ensemble_of,
    final_reward,
    step_rewards,
)
from stlc.controller.options import bounded
from stlc.controller.policies.policy import Policy
from stlc.controller.run.run import load_weights
from stlc.controller.training.config import base_config
from stlc.controller.training.method import Method

if TYPE_CHECKING:
    from stlc.controller.problem.environments import Reward
    from stlc.controller.problem.task import Task
    from stlc.controller.run.config import ResolvedConfig
    from stlc.controller.training.config import TrainConfig
    from stlc.rundir import RunDir

ROWS = 20_000
"""Maximum number of imagined states that are advanced at a time."""
LEAST = 1e-3
"""Least standard deviation of a population, as a share of the width of a control range."""
EVERY, POOL = 10, 16
"""Steps between validations, and states judged by one; few, since a plan takes a search."""


@dataclass(frozen=True, slots=True)
class PetsConfig(ModelConfig):
    """Options of PETS.

    Attributes:
        ahead: number of steps that a search covers. If it is positive, a search is made for every step of the
            plan, and only the first control of its result is used. If it is 0, one search covers the whole
            plan. For the rewards `robustness` and `accuracy`, which need a whole episode, `ahead` counts
            as 0.
        piece: number of steps over which a control is constant.
        population: number of control sequences in a round.
        rounds: number of rounds of the cross-entropy method.
        elite_share: share of the population that counts as best. These sequences determine the mean and
            variance of the next round.
        inertia: weight of the mean and variance of the round before (alpha of Chua et al. 2018).
        particles: number of imagined episodes per control sequence. They are distributed evenly over the
            elites, the networks with the least validation error.
    """

    environments: int = bounded(8, 1, 65_536)
    first: int = 200
    ahead: int = 0
    piece: int = bounded(5, 1, 10**6)
    population: int = bounded(100, 1, 10**6)
    rounds: int = bounded(4, 1, 10**6)
    elite_share: float = bounded(0.1, 0, 1)
    inertia: float = bounded(0.1, 0, 1)
    particles: int = bounded(5, 1, 4096)


class PetsPolicy(Policy):
    """Policy that plans with a learnt model; the same state gives the same plan.

    Args:
        task: specification and system.
        model: learnt model of the system.
        config: options of the search.
    """

    judged_at_once = 16

    def __init__(self, task: Task, model: LearntModel, config: PetsConfig) -> None:
        super().__init__(task)
        self._model, self._config = model, config
        self._reward = cast("Reward", config.reward)
        members = min(config.particles, model.predictor.elites)
        self._shape = members, config.particles // members

    @torch.no_grad()
    def candidates(self, x0: Tensor) -> Tensor:
        """One plan per state: (B, n) -> (B, 1, T, m)."""
        generator = torch.Generator().manual_seed(self._config.seed)
        return self.sequence(x0.float(), generator).to(x0)[:, None]

    @torch.no_grad()
    def continuation(self, x0: Tensor) -> Tensor:
        """Plans found quickly: (B, n) -> (B, T, m).

        One search covers the whole plan, in a single round and with one particle per control sequence.
        """
        quick = replace(self._config, ahead=0, rounds=1, particles=1)
        other = PetsPolicy(self.task, self._model, quick)
        generator = torch.Generator().manual_seed(self._config.seed)
        return other.sequence(x0.float(), generator).to(x0)

    @torch.no_grad()
    def sequence(self, x0: Tensor, generator: torch.Generator) -> Tensor:
        """Search for plans from states: (B, n) -> (B, T, m).

        If `config.ahead` is 0 or the reward is not `task`, one search finds the whole plan. Otherwise a
        search is made for each step, and the first control of its result is used. The next search starts from
        the state after this step, computed by the exact model of the system, not by the learnt one.
        """
        if not self._config.ahead or self._reward != "task":
            return self._optimised(x0, self.task.horizon, generator)
        x, actions = x0, []
        ahead = min(self._config.ahead, self.task.horizon)
        guess: Tensor | None = None
        for _ in range(self.task.horizon):
            found = self._optimised(x, ahead, generator, guess)
            actions.append(found[:, 0])
            guess = torch.cat((found[:, 1:], found[:, -1:]), 1)  # the former plan, one step later
            x = self.task.system.step(x, actions[-1])
        return torch.stack(actions, 1)

    def _optimised(
        self, x0: Tensor, steps: int, generator: torch.Generator, guess: Tensor | None = None
    ) -> Tensor:
        """Search by the cross-entropy method for the controls of the next steps, from states `x0` (B, n).

        Args:
            x0: states, (B, n).
            steps: number of steps.
            generator: source of the random numbers of the search and of the predictions.
            guess: mean of the first round, (B, steps, m); None: the middle of the control ranges.

        Returns:
            Controls, (B, steps, m).
        """
        size = max(1, ROWS // (self._config.population * math.prod(self._shape)))
        guesses = [None] * len(x0) if guess is None else torch.split(guess, size)
        parts = zip(torch.split(x0, size), guesses, strict=False)
        return torch.cat([self._searched(part, steps, generator, start) for part, start in parts])

    def _searched(self, x0: Tensor, steps: int, generator: torch.Generator, guess: Tensor | None) -> Tensor:
        """Search for controls by the cross-entropy method, for all states in one batch.

        The arguments and the result are those of `_optimised`. Each round samples from a Gaussian, whose mean
        and variance follow those of the best sequences of the round before.
        """
        config, system = self._config, self.task.system
        low, high = system.control_low, system.control_high
        pieces = -(-steps // config.piece)
        mean = (0.5 * (low + high)).expand(len(x0), pieces, -1)
        if guess is not None:
            mean = guess[:, :: config.piece]
        variance = (0.25 * (high - low)).square().expand_as(mean)
        best = torch.full((len(x0),), -torch.inf)
        chosen = mean.clone()
        elites = max(1, round(config.elite_share * config.population))
        rows = torch.arange(len(x0))
        for _ in range(config.rounds):
            room = 0.5 * torch.minimum(mean - low, high - mean)  # two deviations are within the range
            deviation = torch.minimum(variance, room.square()).sqrt().clamp(min=LEAST * (high - low))
            shape = (len(x0), config.population, pieces, len(low))
            noise = torch.randn(shape, generator=generator).clamp(-2.0, 2.0)
            sampled = torch.clamp(mean[:, None] + deviation[:, None] * noise, low, high)
            values = self._values(x0, sampled.repeat_interleave(config.piece, 2)[:, :, :steps], generator)
            value, which = values.max(1)
            better = value > best
            best = torch.where(better, value, best)
            chosen = torch.where(better[:, None, None], sampled[rows, which], chosen)
            top = values.topk(elites, 1).indices
            kept = sampled[rows[:, None], top]
            mean = config.inertia * mean + (1.0 - config.inertia) * kept.mean(1)
            variance = config.inertia * variance + (1.0 - config.inertia) * kept.var(1, unbiased=False)
        return chosen.repeat_interleave(config.piece, 1)[:, :steps]

    def _values(self, x0: Tensor, sequences: Tensor, generator: torch.Generator) -> Tensor:
        """Value of control sequences, (B, P): the mean reward of their particles (imagined episodes).

        Args:
            x0: states, (B, n).
            sequences: controls of P sequences per state, (B, P, steps, m).
            generator: source of the random numbers of the predictions.
        """
        members, each = self._shape
        batch, count, steps = sequences.shape[:3]
        flat = sequences.flatten(0, 1).repeat(each, 1, 1)
        x = x0.repeat_interleave(count, 0).repeat(each, 1).expand(members, -1, -1)
        u = flat.expand(members, -1, -1, -1)
        total, path = x.new_zeros(x.shape[:2]), [x]
        for step in range(steps):
            x = self._model.step(x, u[:, :, step], generator)
            if self._reward == "task":
                total += step_rewards(self.task, path[-1], x, u[:, :, step])
            path.append(x)
        if self._reward != "task":
            states = torch.stack(path, 2).flatten(0, 1)
            total = final_reward(self.task, self._reward, states).view(members, -1)
        values = torch.nan_to_num(total, nan=-torch.inf).view(members * each, batch, count).mean(0)
        return torch.nan_to_num(values, nan=-torch.inf)


class PetsLearner(ModelLearner):
    """Training by PETS: plans are found with the ensemble, which then learns from the resulting episodes."""

    config: PetsConfig

    @property
    def policy(self) -> PetsPolicy:
        """Policy that plans with the present weights of the ensemble."""
        return PetsPolicy(self.task, self.model, self.config)

    def advance(self) -> float:
        """Plan and simulate `config.environments` episodes.

        Returns:
            The validation error of the ensemble, see `train_ensemble`; NaN if its first training diverged.
        """
        plans: list[Tensor] = []
        planner = self.policy

        def act(states: Tensor, step: int) -> Tensor:
            if not step:
                plans.append(planner.sequence(states, self.generator))
            return plans[0][:, step]

        if not self.observed(act):
            return math.nan
        self.step += 1
        self.loss = self.error
        return self.loss

    def settle(self) -> bool:
        """Train the ensemble if enough episodes were added; its validation error is the loss of the step."""
        good = super().settle()
        self.loss = self.error
        return good


class Pets(Method):
    """Planning with a learnt ensemble by the cross-entropy method."""

    options = PetsConfig
    learns = PetsLearner
    extendable = True  # no step depends on the planned number of steps

    def resolve(self, task: Task, config: TrainConfig) -> PetsConfig:
        """Determine the options.

        A validation judges plans from fewer states than in other methods, since planning takes long.
        """
        found = base_config(task, config, kind=PetsConfig)
        return replace(found, hidden=(200,) * 4, plans=1, every=EVERY, pool=POOL)

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> PetsPolicy:  # noqa: ARG002
        """Load the ensemble of a run as a policy that plans with it."""
        assert isinstance(config, PetsConfig)
        ensemble = load_weights(run, ensemble_of(task, config), "ensemble")
        return PetsPolicy(task, LearntModel(task, ensemble.predictor()), config)


METHOD = Pets()
