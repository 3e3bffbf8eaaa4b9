"""Episodes of a task, simulated in one batch, for learners that choose one action per step.

An episode begins at a random initial state and has as many steps as a plan. There are three rewards, which
Meng and Fan (2023) compare. `task` (RL_R) is the reward that the system file declares for every step. The
others are given once, at the end of an episode. `robustness` (RL_S) is the robustness of the episode.
`accuracy` (RL_A) is positive if the episode satisfies the specification, else 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.native import NativeStep
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.diagnostics import usage

Reward: TypeAlias = Literal["task", "robustness", "accuracy"]
"""Reward of learners; `task` is the one that the system file declares (`train: {reward: …}`)."""
REWARDS: tuple[Reward, ...] = get_args(Reward)

SATISFIED = 100.0
"""Reward `accuracy` of an episode that satisfies the specification (RL_A of Meng and Fan 2023)."""
MOST = 10.0
"""Bound on the magnitude of the reward `robustness`, since robustness may be infinite."""


def require_reward(task: Task, reward: str) -> None:
    """Check that a task has the reward `reward`.

    Raises:
        UsageError: U101, no reward has this name; or the name is `task`, and the system declares no reward.
    """
    if reward not in REWARDS:
        raise usage(f"there is no reward `{reward}`", f"rewards: {', '.join(REWARDS)}")
    if reward == "task":
        task.system.require_reward()


def reward_at_end(reward: Reward, rho: Tensor) -> Tensor:
    """Reward of episodes at their end, computed from their robustness: (N,) -> (N,); 0 for reward `task`.

    Episodes whose robustness is NaN are violated.
    """
    match reward:
        case "task":
            return torch.zeros_like(rho)
        case "accuracy":
            return SATISFIED * TOLERANCE.satisfied(rho).to(rho)
        case "robustness":
            return torch.nan_to_num(rho, nan=-MOST).clamp(-MOST, MOST)


@dataclass(frozen=True, slots=True)
class Transition:
    """Result of one step of all environments.

    Attributes:
        observation: observation after the step, (N, k); if the episodes ended, that of their new initial
            states.
        reward: reward of the step, (N,).
        done: True for episodes that ended with the step, (N,) bool.
        final: observation after the step, before any reset, (N, k).
        rho: robustness of the episodes that ended, (N,); NaN for others.
        verdicts: exact verdicts on the episodes; None before their end.
        states: states after the step, before any reset, (N, n).
    """

    observation: Tensor
    reward: Tensor
    done: Tensor
    final: Tensor
    rho: Tensor
    verdicts: PlanVerdicts | None
    states: Tensor

    @property
    def satisfied(self) -> Tensor:
        """Mask of the episodes that ended and satisfy the specification, (N,)."""
        return self.done & TOLERANCE.satisfied(self.rho)


def observe(task: Task, states: Tensor, step: int) -> Tensor:
    """Observations: the policy's inputs and the elapsed share of the episode at `step`, (B, n) -> (B, k)."""
    seen = task.system.observe(states)
    return torch.cat((seen, seen.new_full((*seen.shape[:-1], 1), step / task.horizon)), -1)


class Environments:
    """Episodes of one task in one batch; all begin and end together.

    Steps are compiled to C if possible. States are float64, observations float32.

    Args:
        task: specification and system.
        count: number of episodes, N.
        reward: name of the reward.
        generator: source of the random numbers for the initial states.
        ahead: number of initial states that are drawn at a time, since drawing few is slow; 0: `count`.

    Raises:
        UsageError: U101, no reward has the name `reward`; or the name is `task`, and the system declares no
            reward.

    Attributes:
        task: specification and system.
        count: number of episodes, N.
        steps: number of steps of an episode: the horizon of a plan.
        states: present states, (N, n).
    """

    def __init__(
        self,
        task: Task,
        count: int,
        *,
        reward: Reward = "robustness",
        generator: torch.Generator,
        ahead: int = 0,
    ) -> None:
        require_reward(task, reward)
        self.task, self.count, self.steps = task, count, task.system.horizon
        self._reward, self._generator, self._ahead = reward, generator, ahead
        self._native = NativeStep.of(task.system, rewarded=reward == "task")
        self._low, self._high = task.system.control_low.double(), task.system.control_high.double()
        self._drawn = torch.empty(0, len(task.system.names), dtype=torch.float64)
        self._step = 0
        self._actions = self._blank()
        self.states = self._start = self._starts()

    @property
    def width(self) -> int:
        """Number of observed values, k."""
        return self.task.system.observed_count + 1

    def observe(self, states: Tensor, step: int) -> Tensor:
        """Observations of states (B, n) at step number `step` of the episode: (B, k).

        They consist of the policy's inputs and the elapsed share of the episode.
        """
        return observe(self.task, states, step)

    @torch.no_grad()
    def reset(self, states: Tensor | None = None) -> Tensor:
        """Begin all episodes at random initial states, or at `states` (N, n); return observations (N, k)."""
        self.states = self._start = self._starts() if states is None else states.double()
        self._step, self._actions = 0, self._blank()
        if self._native is not None:
            return self._native.look(self.states, 0.0)
        return self.observe(self.states, 0).float()

    def seed(self, seed: int) -> None:
        """Seed the random initial states; it takes effect at the next `reset`."""
        self._generator.manual_seed(seed)
        self._drawn = self._drawn[:0]

    @torch.no_grad()
    def step(self, actions: Tensor) -> Transition:
        """Advance all episodes by one step; after their last step all begin anew.

        Args:
            actions: actions in physical units, (N, m); clipped to their ranges.
        """
        held = torch.clamp(actions.double(), self._low, self._high)
        self._actions[:, self._step] = held
        self._step += 1
        self.states, final, earned = self._moved(held)
        over, states = self._step == self.steps, self.states
        done = torch.full((self.count,), over)
        if not over:
            return Transition(final, earned, done, final, torch.full((self.count,), torch.nan), None, states)
        verdicts = self.task.judge(self._start, self._actions, states=False)
        reward = earned + reward_at_end(self._reward, verdicts.rho).float()
        return Transition(self.reset(), reward, done, final, verdicts.rho.float(), verdicts, states)

    def _moved(self, held: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Make one step under the clipped actions `held`, (N, m), without restarting episodes.

        Returns:
            States after the step (N, n), their observations (N, k), and rewards (N,): those that the system
            declares if the reward is `task`, else 0.
        """
        share = self._step / self.steps
        if self._native is not None:
            after, seen, reward = self._native.advance(self.states, held, share)
        else:
            system = self.task.system
            after, reward = system.step(self.states, held), None
            seen = self.observe(after, self._step).float()
            if self._reward == "task":
                reward = system.reward(after, system.commanded(self.states, held))
        return after, seen, torch.zeros(self.count) if reward is None else reward.float()

    def _blank(self) -> Tensor:
        """Make an array of zeros, (N, T, m), to which the actions of the episodes are written."""
        return torch.zeros((self.count, self.steps, len(self._low)), dtype=torch.float64)

    def _starts(self) -> Tensor:
        """Draw random initial states, (N, n) float64."""
        if len(self._drawn) < self.count:
            drawn = max(self.count, self._ahead)
            self._drawn = self.task.sample(drawn, generator=self._generator, dtype=torch.float64)
        starts, self._drawn = self._drawn[: self.count], self._drawn[self.count :]
        return starts.contiguous()
