"""Policies of learners of one action a step: the plan is the actor's closed loop on the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.controller.policies.policy import Policy
from stlc.controller.problem.environments import observe
from stlc.controller.training.config import ResolvedConfig

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class ActorConfig(ResolvedConfig):
    """Options of a learner of one action a step.

    Attributes:
        reward: of an episode (`stlc.controller.problem.environments.Reward`).
        environments: number of episodes side by side.
    """

    reward: str = "robustness"
    environments: int = 64


class ActorPolicy(Policy):
    """Policy of an actor that sees the elapsed share of the plan beside the state.

    Args:
        task: specification and system.
        actor: observations (B, k) float32 -> controls (B, m) in physical units; see `observe`.
    """

    def __init__(self, task: Task, actor: Callable[[Tensor], Tensor]) -> None:
        super().__init__(task)
        self.actor = actor

    @torch.no_grad()
    def candidates(self, x0: Tensor) -> Tensor:
        """One plan per state: (B, n) -> (B, 1, T, m)."""
        system, x, actions = self.task.system, x0, []
        low, high = system.control_low.to(x0), system.control_high.to(x0)
        for step in range(self.task.horizon):
            seen = observe(self.task, x, step).float()
            actions.append(torch.clamp(self.actor(seen).to(x0), low, high))
            x = system.step(x, actions[-1])
        return torch.stack(actions, 1)[:, None]


def below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Entries under `prefix.`, without the prefix."""
    start = prefix + "."
    return {name.removeprefix(start): value for name, value in tensors.items() if name.startswith(start)}


def optimizer_tensors(optimizer: torch.optim.Optimizer, prefix: str) -> dict[str, Tensor]:
    """State of an optimiser by name."""
    states = optimizer.state_dict()["state"].items()
    return {f"{prefix}.{index}.{name}": value for index, state in states for name, value in state.items()}


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Restore the state of `optimizer_tensors`, without the prefix."""
    layout = optimizer.state_dict()
    for key, value in tensors.items():
        index, name = key.split(".")
        layout["state"].setdefault(int(index), {})[name] = value
    optimizer.load_state_dict(layout)
