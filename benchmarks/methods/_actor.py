"""Policies that take their plans from an actor, a network that chooses one action per step.

The actor runs in closed loop on the model of the system. The sequence of its controls is the plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self, get_args

import torch
from torch import Tensor

from stlc.controller.options import bounded
from stlc.controller.policies.policy import ActorNetwork, ClosedLoopActor, Policy
from stlc.controller.problem.environments import Reward, observe
from stlc.controller.problem.native import NativeStep
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.training.method import Learner

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.controller.problem.task import Task
    from stlc.dynamics.system import System


@dataclass(frozen=True, slots=True)
class ActorConfig(ResolvedConfig):
    """Options of a method that learns an actor, which chooses one action per step.

    Attributes:
        reward: name of the reward of an episode (`stlc.controller.problem.environments.Reward`).
        environments: number of episodes that are simulated in parallel.
    """

    reward: str = "robustness"
    environments: int = bounded(64, 1, 65_536)

    def __post_init__(self) -> None:
        if self.reward not in get_args(Reward):
            known = ", ".join(get_args(Reward))
            raise ValueError(f"`reward` is {self.reward!r:.40}, none of {known}")


class ActorPolicy(Policy):
    """Policy whose plan is the sequence of controls of an actor in closed loop on the model.

    The actor observes the state and the elapsed fraction of the plan.

    Args:
        task: specification and system.
        actor: network from observations (B, k) float32 to controls (B, m) in physical units. The function
            `stlc.controller.problem.environments.observe` computes the observations.
    """

    network: ClosedLoopActor

    def __init__(self, task: Task, actor: ActorNetwork) -> None:
        super().__init__(task)
        self.network = ClosedLoopActor(task, actor)
        self._compiled: tuple[System, NativeStep | None] | None = None

    def for_task(self, task: Task) -> Self:
        """Copy of this policy whose actor runs on the model of `task`, another task of the same system."""
        other = super().for_task(task)
        other.network = ClosedLoopActor(task, self.network.actor)
        return other

    @torch.no_grad()
    def candidates(self, x0: Tensor) -> Tensor:
        """One plan per state: (B, n) -> (B, 1, T, m) float64. The closed loop runs in C if possible."""
        x, actions = x0.double(), []
        native = self._native(self.task.system) if x0.device.type == "cpu" else None
        if native is None:
            plans: Tensor = self.network(x)
            return plans
        seen = observe(self.task, x, 0).float()
        for step in range(1, self.task.horizon + 1):
            actions.append(self.network.act(seen))
            x, seen, _ = native.advance(x, actions[-1], step / self.task.horizon)
        return torch.stack(actions, 1)[:, None]

    def _native(self, system: System) -> NativeStep | None:
        """Compiled step of a system; None if the step cannot be compiled and torch has to be used."""
        if self._compiled is None or self._compiled[0] is not system:
            self._compiled = system, NativeStep.of(system, rewarded=False)
        return self._compiled[1]


class ActorLearner(Learner):
    """Reinforcement learning of an actor (a network that chooses one action per step)."""

    def torch_reasons(self) -> Mapping[str, str]:
        """Reason why plans are judged in torch; "" if they are judged in C.

        Returns:
            A mapping from `verdicts`, its only key, to the reason.
        """
        reasons = super().torch_reasons()
        return {"verdicts": reasons["verdicts"]}


def finite_weights(network: torch.nn.Module) -> bool:
    """True if all weights of a network are finite."""
    return all(bool(torch.isfinite(weight).all()) for weight in network.parameters())


def optimizer_tensors(optimizer: torch.optim.Optimizer, prefix: str) -> dict[str, Tensor]:
    """State of an optimiser as tensors, whose names begin with `prefix.`."""
    states = optimizer.state_dict()["state"].items()
    return {f"{prefix}.{index}.{name}": value for index, state in states for name, value in state.items()}


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Restore an optimiser from the tensors that `optimizer_tensors` returned.

    The caller has removed the prefix from the names: `adam.0.step` has become `0.step`, for example.
    """
    layout = optimizer.state_dict()
    for key, value in tensors.items():
        index, name = key.split(".")
        layout["state"].setdefault(int(index), {})[name] = value
    optimizer.load_state_dict(layout)
