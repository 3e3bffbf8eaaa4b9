"""Episodes of a task on its model, many side by side: the environment of learners of one action a step.

An episode begins at a random initial state and has as many steps as a plan. Rewards are those that the paper
compares: the declared one of every step (RL_R), the robustness of an episode (RL_S), or whether it satisfies
the specification (RL_A), at its end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import torch
from torch import Tensor

from stlc.controller.problem.task import satisfied
from stlc.diagnostics import usage

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

Reward: TypeAlias = Literal["task", "robustness", "accuracy"]
"""Reward of learners; `task` is the one that the system file declares (`train: {reward: …}`)."""

SATISFIED = 100.0
"""Reward `accuracy` of an episode that satisfies the specification (the paper's RL_A)."""
MOST = 10.0
"""Bound on both sides of the reward `robustness`, which may be infinite."""


@dataclass(frozen=True, slots=True)
class Transition:
    """Result of one step of all environments.

    Attributes:
        observation: after the step; where an episode ended, of the next one's initial state, (N, k).
        reward: (N,).
        done: where an episode ended, (N,) bool.
        final: observation after the step, before any reset, (N, k).
        rho: robustness of the episodes that ended, (N,); NaN elsewhere.
    """

    observation: Tensor
    reward: Tensor
    done: Tensor
    final: Tensor
    rho: Tensor

    @property
    def satisfied(self) -> Tensor:
        """Mask of the episodes that ended and satisfy the specification, (N,)."""
        return self.done & satisfied(self.rho)


class Environments:
    """Episodes of one task, side by side in one batch; all begin and end together.

    Raises UsageError (U101) for reward `task` where the system declares none, or for another name.

    Attributes:
        task: specification and system.
        count: number of episodes, N.
        steps: of an episode: the horizon of a plan.
        states: present states, (N, n).
    """

    def __init__(
        self, task: Task, count: int, *, reward: Reward = "robustness", generator: torch.Generator
    ) -> None:
        self.task, self.count, self.steps = task, count, task.system.horizon
        if reward not in get_args(Reward):
            raise usage(f"there is no reward `{reward}`", f"rewards: {', '.join(get_args(Reward))}")
        if reward == "task":
            task.system.require_reward()
        self._reward, self._generator = reward, generator
        self.states = task.sample(count, generator=generator)
        self._start, self._step = self.states, 0
        self._actions = self.states.new_zeros(count, self.steps, len(task.system.control_names))

    @property
    def width(self) -> int:
        """Number of observed values, k."""
        return self.task.system.observed_count + 1

    def observe(self, states: Tensor, step: int) -> Tensor:
        """Inputs of the policy and the elapsed share of the episode: (B, n) -> (B, k)."""
        seen = self.task.system.observe(states)
        return torch.cat((seen, seen.new_full((*seen.shape[:-1], 1), step / self.steps)), -1)

    @torch.no_grad()
    def reset(self) -> Tensor:
        """Draw new initial states; return their observations, (N, k)."""
        self.states = self.task.sample(self.count, generator=self._generator)
        self._start, self._step = self.states, 0
        return self.observe(self.states, 0)

    @torch.no_grad()
    def step(self, actions: Tensor) -> Transition:
        """Advance all episodes by one step; episodes that end begin anew.

        Args:
            actions: in physical units, clipped to their ranges, (N, m).
        """
        system = self.task.system
        held = torch.clamp(actions.to(self.states), system.control_low, system.control_high)
        self._actions[:, self._step] = held
        before, self.states = self.states, system.step(self.states, held)
        self._step += 1
        over = self._step == self.steps
        final = self.observe(self.states, self._step)
        done = torch.full((self.count,), over)
        reward, rho = self._rewarded(before, held, over)
        return Transition(self.reset() if over else final, reward, done, final, rho)

    def _rewarded(self, before: Tensor, held: Tensor, over: bool) -> tuple[Tensor, Tensor]:
        """Reward of the step from `before` with controls `held`; robustness of episodes that are `over`."""
        system, earned = self.task.system, self.states.new_zeros(self.count)
        if self._reward == "task":
            earned = system.reward(self.states, system.commanded(before, held))
        if not over:
            return earned, torch.full_like(earned, torch.nan)
        rho = self.task.judge(self._start, self._actions, states=False).rho
        match self._reward:
            case "task":
                return earned, rho
            case "accuracy":
                return SATISFIED * satisfied(rho).to(rho), rho
            case "robustness":
                return torch.nan_to_num(rho).clamp(-MOST, MOST), rho
