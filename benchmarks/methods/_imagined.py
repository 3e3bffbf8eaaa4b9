"""Episodes of a task, simulated (observed) or predicted by a learnt model (imagined), and their rewards.

Observed episodes are simulated with the model of the system and stored; an ensemble learns from them, and
predicts imagined episodes. The ensemble predicts only the states of the system itself. The states that the
specification adds (parameters and timers) are computed from these, and the reward is that of the task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor

from benchmarks.methods._actor import ActorConfig, optimizer_tensors, restore_optimizer
from benchmarks.methods._ensemble import Ensemble, Fit, Predictor, optimizer_of, train_ensemble
from stlc.controller.options import bounded
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.problem.environments import Environments, Reward, reward_at_end
from stlc.controller.run.checkpoint import below
from stlc.controller.training.method import Learner
from stlc.diagnostics import usage

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from stlc.controller.problem.task import Task

PIECE = 5
"""Steps over which the controls of the first, random episodes are constant."""


RARE = 0.1
"""Growth of the number of episodes from which trainings of the networks are rare."""


@dataclass(frozen=True, slots=True)
class ModelConfig(ActorConfig):
    """Options of a method that learns a model of the system.

    Attributes:
        networks: number of networks of the ensemble.
        elites: number of networks used for predictions: those with the least validation error.
        width: number of units per hidden layer.
        layers: number of hidden layers.
        model_lr: learning rate of the networks.
        model_decay: factor of the penalty on the sum of squared weights.
        model_batch: number of samples per gradient step and network.
        model_epochs: maximum number of passes over the data after new episodes.
        model_patience: number of passes without improvement after which training of the networks ends; 0: all
            passes are made.
        model_held: share of the samples held out for validation of the networks.
        growth: share by which the number of episodes has to grow before the networks are trained again; 0.5
            means 50 %, and 0 means that the networks are trained in every training step.
        until: share of the planned training steps after which the networks are not trained any more. One
            training of the networks takes as long as many training steps, and exceeds a time budget if it
            begins too late. 1: no limit.
        first: number of episodes with random controls before the networks are trained for the first time.
        capacity: number of episodes that are stored; new ones replace the oldest.
    """

    environments: int = bounded(16, 1, 65_536)
    networks: int = bounded(7, 1, 64)
    elites: int = bounded(5, 1, 64)
    width: int = bounded(200, 1, 8192)
    layers: int = bounded(4, 1, 32)
    model_lr: float = 2e-3
    model_decay: float = 1e-5
    model_batch: int = bounded(64, 1, 10**8)
    model_epochs: int = 20
    model_patience: int = 5
    model_held: float = bounded(0.2, 0, 0.9)
    growth: float = 0.5
    until: float = bounded(1.0, 0, 1)
    first: int = bounded(200, 2, 10**6)
    capacity: int = bounded(20_000, 2, 10**6)

    @property
    def fit(self) -> Fit:
        """Options of the training of the ensemble."""
        return Fit(
            self.model_lr,
            self.model_decay,
            self.model_batch,
            self.model_epochs,
            self.model_patience,
            self.model_held,
        )


# ------------------------------------------------------------------ episodes and rewards


def rewards(task: Task, kind: Reward, states: Tensor, actions: Tensor) -> Tensor:
    """Rewards of all steps of whole episodes, (B, T).

    They equal the rewards that the class `Environments` gives while it simulates the same episodes.

    Args:
        task: specification and system.
        kind: name of the reward.
        states: (B, T+1, n).
        actions: controls within their ranges, (B, T, m).
    """
    if kind == "task":
        return step_rewards(task, states[:, :-1], states[:, 1:], actions)
    found = actions.new_zeros(actions.shape[:2])
    found[:, -1] = final_reward(task, kind, states)
    return found


def final_reward(task: Task, kind: Reward, states: Tensor) -> Tensor:
    """Reward of whole episodes, (B,), computed from their states, (B, T+1, n).

    `kind`: `robustness` or `accuracy`, the two rewards that an episode earns at its end.
    """
    return reward_at_end(kind, task.robustness(states))


def step_rewards(task: Task, before: Tensor, after: Tensor, actions: Tensor) -> Tensor:
    """Rewards of single steps, (…,), as the system file declares them (reward `task`).

    `…` in the shapes stands for any leading dimensions, which the result has too.

    Args:
        task: specification and system.
        before: states before the steps, (…, n).
        after: states after the steps, (…, n).
        actions: controls of the steps, within their ranges, (…, m).
    """
    system, shape = task.system, actions.shape[:-1]
    flat = [part.reshape(-1, part.shape[-1]) for part in (before, after, actions)]
    return system.reward(flat[1], system.commanded(flat[0], flat[2])).to(actions).view(shape)


class Episodes:
    """Memory of the latest observed episodes.

    Attributes:
        states: (capacity, T+1, n); only the first `count` entries are filled.
        actions: (capacity, T, m).
        rewards: (capacity, T).
        count: number of stored episodes.
        total: number of episodes ever added.
    """

    def __init__(self, task: Task, capacity: int) -> None:
        system = task.system
        self.states = torch.zeros(capacity, system.horizon + 1, len(system.names))
        self.actions = torch.zeros(capacity, system.horizon, len(system.control_names))
        self.rewards = torch.zeros(capacity, system.horizon)
        self.count = self.total = 0

    def add(self, states: Tensor, actions: Tensor, earned: Tensor) -> None:
        """Store episodes: `states` (N, T+1, n), `actions` (N, T, m), and their rewards `earned` (N, T).

        If the memory is full, the new episodes replace the oldest ones.
        """
        at = (self.total + torch.arange(len(states))) % len(self.states)
        self.states[at], self.actions[at], self.rewards[at] = states, actions, earned
        self.total += len(states)
        self.count = min(self.total, len(self.states))

    def transitions(self, own: int) -> tuple[Tensor, Tensor]:
        """Training data of the ensemble: one sample per stored step.

        Args:
            own: number of states of the system itself, without those that the specification adds.

        Returns:
            Inputs (states and controls), (N, own + m), and targets (changes of the states in a step),
            (N, own).
        """
        states, actions = self.states[: self.count, :, :own], self.actions[: self.count]
        before, after = states[:, :-1].flatten(0, 1), states[:, 1:].flatten(0, 1)
        return torch.cat((before, actions.flatten(0, 1)), 1), after - before

    def tensors(self) -> dict[str, Tensor]:
        """Stored episodes as tensors by name."""
        names = ("states", "actions", "rewards")
        found = {f"episodes.{name}": getattr(self, name)[: self.count].clone() for name in names}
        return found | {"episodes.total": torch.tensor(self.total)}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the episodes from `tensors`, which the method of this name returned.

        The caller has removed the prefix `episodes.` from the names of the tensors.
        """
        self.total, self.count = int(tensors["total"]), len(tensors["states"])
        for name in ("states", "actions", "rewards"):
            getattr(self, name)[: self.count] = tensors[name]


@torch.no_grad()
def play(task: Task, x0: Tensor, act: Callable[[Tensor, int], Tensor]) -> tuple[Tensor, Tensor]:
    """Simulate episodes from the states `x0`, (N, n), with the model of the system.

    `act(states, step)` gives the controls of a step. They are clipped to the control ranges.

    Returns:
        States (N, T+1, n) and clipped controls (N, T, m).
    """
    system = task.system
    states, actions = [x0], []
    for step in range(system.horizon):
        actions.append(torch.clamp(act(states[-1], step), system.control_low, system.control_high))
        states.append(system.step(states[-1], actions[-1]))
    return torch.stack(states, 1), torch.stack(actions, 1)


def random_controls(task: Task, count: int, generator: torch.Generator) -> Tensor:
    """Draw `count` random plans, (count, T, m); their controls change only every `PIECE` steps."""
    system = task.system
    pieces = -(-system.horizon // PIECE)
    drawn = torch.rand(count, pieces, len(system.control_names), generator=generator)
    drawn = system.control_low + (system.control_high - system.control_low) * drawn
    return drawn.repeat_interleave(PIECE, 1)[:, : system.horizon]


# ------------------------------------------------------------------ the learnt model


class LearntModel:
    """Learnt model of one step of the system, which draws the next states from an ensemble.

    Parameters and timers, the states that the specification adds, are computed exactly.
    """

    def __init__(self, task: Task, predictor: Predictor) -> None:
        self.task, self.predictor = task, predictor
        self._own = len(task.system.decl.signature.names)

    @torch.no_grad()
    def step(self, x: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """Draw the states one step later; network number i predicts from the states `x[i]`.

        Args:
            x: states, (k, B, n), where k is at most the number of networks that predict.
            u: controls within their ranges, (k, B, m).
            generator: source of the random numbers of the predictions.

        Returns:
            Next states, (k, B, n).
        """
        own = x[..., : self._own]
        moved = own + self.predictor(torch.cat((own, u), -1), generator)
        if self._own == x.shape[-1]:
            return moved
        added = self.task.system.added_later(x.flatten(0, 1)).view(*x.shape[:2], -1)
        return torch.cat((moved, added), -1)


class ModelLearner(Learner):
    """Training with a learnt model. An ensemble of networks learns the system from observed episodes.

    One step of the training simulates `config.environments` episodes and does what the subclass adds. After
    it, the ensemble is trained if enough episodes were added since its last training. A checkpoint holds the
    networks, the stored episodes and the state of the random number generator.

    Attributes:
        episodes: the stored episodes.
        ensemble: the learnt model.
        fitted: value of `episodes.total`, the number of episodes ever observed, when the ensemble was last
            trained.
        error: validation error of the ensemble after its latest training; NaN before the first.
    """

    config: ModelConfig

    def __init__(
        self, task: Task, config: ModelConfig, *, steps: int, device: torch.device, ranks: Ranks = ALONE
    ) -> None:
        """Make an untrained ensemble and an empty memory of episodes.

        Raises:
            UsageError: U101, there are several ranks (processes); or the device is not the CPU; or
                `config.reward` is unknown, or is `task` although the system declares no reward.
        """
        super().__init__(task, config, steps=steps, device=device, ranks=ranks)
        if ranks.size > 1:
            raise usage(f"method `{config.method}` trains in one process", "start it without torchrun")
        if device.type != "cpu":
            raise usage(f"method `{config.method}` trains on the processor", "use --device cpu")
        self.reward = cast("Reward", config.reward)
        Environments(task, 1, reward=self.reward, generator=torch.Generator())
        self.episodes = Episodes(task, config.capacity)
        self.ensemble = ensemble_of(task, config)
        self.optimizer = optimizer_of(self.ensemble, config.fit)
        self.fitted = 0
        self.error = math.nan

    @property
    def environment_steps(self) -> int:
        """Number of steps that have been simulated with the model of the system."""
        return self.episodes.total * self.task.system.horizon

    @property
    def model(self) -> LearntModel:
        """Learnt model of the system with the present weights of the ensemble."""
        return LearntModel(self.task, self.ensemble.predictor())

    def observed(self, act: Callable[[Tensor, int], Tensor]) -> bool:
        """Simulate `config.environments` episodes and store them.

        The first call simulates at least `config.first` episodes with random controls instead, and trains the
        ensemble with them.

        Args:
            act: function from states (N, n) and the step to controls (N, m).

        Returns:
            False if the first training of the ensemble diverged, else True.
        """
        config = self.config
        begins = not self.episodes.total
        count = max(config.first, config.environments) if begins else config.environments
        x0 = self.task.sample(count, generator=self.generator)
        if begins:
            plans = random_controls(self.task, count, self.generator)
            states, actions = play(self.task, x0, lambda _, step: plans[:, step])
        else:
            states, actions = play(self.task, x0, act)
        self.episodes.add(states, actions, rewards(self.task, self.reward, states, actions))
        return self._fit() if begins else True

    @property
    def settles_rarely(self) -> bool:  # type: ignore[override]
        """True unless the networks are trained after nearly every step."""
        return self.config.growth >= RARE

    def settle(self) -> bool:
        """Train the ensemble if the number of episodes has grown by the share `config.growth`.

        After the share `config.until` of the planned steps, nothing is done.

        Returns:
            False if the training diverged, else True.
        """
        config = self.config
        enough = self.episodes.total >= (1.0 + config.growth) * self.fitted
        if not enough or self.episodes.total == self.fitted or self.step > config.until * self.steps:
            return True
        return self._fit()

    def _fit(self) -> bool:
        """Train the ensemble with the stored episodes; return False if the training diverged."""
        own = len(self.task.system.decl.signature.names)
        inputs, targets = self.episodes.transitions(own)
        self.error = train_ensemble(
            self.ensemble, self.optimizer, inputs, targets, fit=self.config.fit, generator=self.generator
        )
        self.fitted = self.episodes.total
        return not math.isnan(self.error)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors from which training resumes exactly.

        They contain the state of the random number generator, the stored episodes, the ensemble and its
        optimiser.
        """
        found = super().tensors() | self.episodes.tensors()
        found |= {f"ensemble.{name}": value for name, value in self.ensemble.state_dict().items()}
        return found | optimizer_tensors(self.optimizer, "adam")

    def facts(self) -> dict[str, float | int]:
        error = {"model_error": self.error} if not math.isnan(self.error) else {}
        own = {"fitted": self.fitted, "environment_steps": self.environment_steps}
        return super().facts() | own | error

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float | int]) -> None:
        super().restore(tensors, facts)
        self.episodes.restore(below(tensors, "episodes"))
        self.ensemble.load_state_dict(below(tensors, "ensemble"))
        restore_optimizer(self.optimizer, below(tensors, "adam"))
        self.fitted, self.error = int(facts["fitted"]), float(facts.get("model_error", math.nan))


def ensemble_of(task: Task, config: ModelConfig) -> Ensemble:
    """Make an ensemble whose initial weights depend only on `config.seed`."""
    outputs = len(task.system.decl.signature.names)
    return Ensemble(
        outputs + len(task.system.control_names),
        outputs,
        networks=config.networks,
        elites=config.elites,
        hidden=(config.width,) * config.layers,
        generator=torch.Generator().manual_seed(config.seed),
    )
