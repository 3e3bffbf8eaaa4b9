"""Many environments of one task, simulated as one batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from stlc.controller.problem.environments import MOST, Environments, Transition
from stlc.controller.problem.environments import Reward as EpisodeReward
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.controller.world import ModelWorld
from stlc.diagnostics import usage
from stlc.gym.pictures import MODES, Picture, Pictures, RenderMode, snapshot
from stlc.gym.spaces import Floats, initial_state, of_actuators, of_observation

AHEAD = 1024
"""Least number of initial states that are drawn at a time."""

Info = dict[str, Any]
Flags = NDArray[np.bool_]


class SpecVectorEnv(VectorEnv[Floats, NDArray[np.float32], NDArray[Any]]):
    """Environments of one task on the model of its system, simulated as one batch.

    All episodes begin together, are as long as a plan, and *terminate* together. Observations, (N, k), and
    actions, (N, m), are those of `SpecEnv`. `info` holds `state`, (N, n) float64, and at the end of the
    episodes `robustness` per requirement, `rho` of the whole specification, and `satisfied`, (N,) each. For
    every key `NAME` there is a boolean array under the key `_NAME`. It marks the environments for which
    `NAME` has a value, as in gymnasium's own vector environments.

    Args:
        task: specification and system.
        num_envs: number of environments, N.
        reward: `robustness` of the episode, or `accuracy` (100 if the episode satisfies the specification,
            else 0), given with the last step; or `task`, the reward of each step that the system file
            declares.
        normalised: whether observations and actions are scaled to [-1, 1], which most learners expect.
        time: whether the elapsed share of the episode is observed.
        autoreset: when the next episodes begin. By default (`SAME_STEP`) the last step of an episode returns
            the observations of the next initial states, and `info["final_obs"]` and `info["final_info"]` hold
            observations and info of the end. With `NEXT_STEP` the last step returns the final observations;
            the following step ignores its actions, begins the next episodes and gives the reward 0.
        render_mode: `rgb_array`: `render` returns pictures of the agents in the plane of their first two
            states.

    A copy (`copy.deepcopy`) or a pickle continues the episodes; the task is shared by copies.

    Raises UsageError (U101) if no reward is named `reward`, if it is `task` and the system declares no
    reward, or if another argument is wrong.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        reward: EpisodeReward = "robustness",
        normalised: bool = False,
        time: bool = True,
        autoreset: AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: RenderMode | None = None,
    ) -> None:
        if num_envs < 1:
            raise usage(f"there are no {num_envs} environments", "give at least 1")
        if autoreset is AutoresetMode.DISABLED:
            raise usage(
                "episodes that end begin anew by themselves", "take AutoresetMode.SAME_STEP or NEXT_STEP"
            )
        self.task, self.reward, self.normalised, self.time = task, reward, normalised, time
        self.num_envs, self.autoreset = num_envs, AutoresetMode(autoreset)
        self.render_mode, dt = render_mode, task.system.dt
        self.metadata = {
            **{"render_modes": MODES, "render_fps": max(round(1.0 / dt), 1)},
            "autoreset_mode": self.autoreset,
        }
        self._pictures = [Pictures(render_mode, ModelWorld.draw, dt) for _ in range(num_envs)]
        self._episodes = Environments(
            task, num_envs, reward=reward, generator=torch.Generator(), ahead=max(AHEAD, num_envs)
        )
        self._actuators, self._bounds = of_actuators(task), of_observation(task, time=time)
        self.single_action_space = self._actuators.space(unit=normalised)
        self.single_observation_space = self._bounds.space(unit=normalised)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._all: Flags = np.ones(num_envs, dtype=np.bool_)
        self._begun = False
        self._next: Tensor | None = None

    @property
    def steps(self) -> int:
        """Number of steps of an episode."""
        return self._episodes.steps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, Info]:
        """Begin all episodes. A seed determines the random numbers of these and of all later episodes.

        Args:
            seed: seed of all random numbers from these episodes on, one number for all environments.
            options: `state`, (n,) or (N, n): initial states instead of random ones.

        Returns:
            The first observations, (N, k), and `info`.

        Raises UsageError (U101) for a list of seeds, if only some environments are to be reset, or for a
        wrong state.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            raise usage("all environments share one stream of random numbers", "give one seed, not several")
        given = dict(options or {})
        mask = given.pop("reset_mask", None)
        if mask is not None and not np.all(mask):
            raise usage("all episodes begin and end together", "leave `reset_mask` out")
        super().reset(seed=None if seed is None else int(seed))
        if seed is not None or not self._begun:
            self._episodes.seed(int(self.np_random.integers(2**62)))
        self._begun, self._next = True, None
        state = given.get("state")
        start = None if state is None else initial_state(self.task, state, self.num_envs)
        seen = self._shown(self._episodes.reset(start))
        self._pictured(first=True)
        return seen, self._told(self._episodes.states)

    def render(self) -> tuple[Picture, ...]:
        """Pictures of all environments at the present instant, (height, width, 3) uint8 each.

        Raises UsageError (U101) if the environments were made without `render_mode`, or before `reset`.
        """
        return tuple(each.shown() for each in self._pictures)

    def _pictured(self, *, first: bool) -> None:
        if self.render_mode is not None:
            for pictures, state in zip(self._pictures, self._episodes.states, strict=True):
                pictures.add(snapshot(self.task, state[None]), first=first)

    def step(self, actions: NDArray[np.float32]) -> tuple[Floats, NDArray[np.float64], Flags, Flags, Info]:
        """Advance all environments by one step under `actions`, (N, m).

        Returns:
            Observations (N, k), rewards, whether episodes terminated, whether they were truncated (never),
            (N,) each, and `info`.
        """
        if not self._begun:
            raise usage("no episode has begun", "call `reset` first")
        none: Flags = np.zeros(self.num_envs, dtype=np.bool_)
        if self._next is not None:
            seen, self._next = self._shown(self._next), None
            self._pictured(first=True)
            return seen, np.zeros(self.num_envs), none, none.copy(), self._told(self._episodes.states)
        if np.shape(actions) != self.action_space.shape:
            raise usage(f"actions have the shape {np.shape(actions)}", f"give {self.action_space.shape}")
        held = torch.from_numpy(self._actuators.physical(actions, unit=self.normalised))
        moved = self._episodes.step(self.task.system.planned(self._episodes.states, held))
        reward, done = moved.reward.double().numpy(), moved.done.numpy()
        self._pictured(first=moved.verdicts is not None)
        if moved.verdicts is None:
            return self._shown(moved.final), reward, done, none, self._told(moved.states)
        final, end = self._shown(moved.final), self._at_end(moved, moved.verdicts)
        if self.autoreset is AutoresetMode.NEXT_STEP:
            self._next = moved.observation
            return final, reward, done, none, end
        info = self._told(self._episodes.states)
        rows = np.empty(len(final), dtype=object)  # an array of arrays: the form of `final_obs`
        for i, row in enumerate(final):
            rows[i] = row
        info |= self._marked({"final_obs": rows, "final_info": end})
        return self._shown(moved.observation), reward, done, none, info

    def _shown(self, seen: Tensor) -> Floats:
        """Clip the observations `seen` to their bounds and, if requested, normalise them: (N, k).

        The last entry of `seen` is the elapsed share of the episode. It is dropped if `time` is False.
        """
        values = seen.numpy() if self.time else seen[:, :-1].numpy()
        return self._bounds.shown(values, unit=self.normalised)

    def _told(self, states: Tensor) -> Info:
        return self._marked({"state": states.numpy(force=True)})

    def _at_end(self, moved: Transition, verdicts: PlanVerdicts) -> Info:
        """Info of all environments at the end of their episodes: states, robustness, and verdicts."""
        each = verdicts.requirements.clamp(-MOST, MOST).numpy(force=True)
        names = (rule.name for rule in self.task.rules)
        robustness = {name: each[:, i] for i, name in enumerate(names)}
        rho = torch.nan_to_num(verdicts.rho).clamp(-MOST, MOST)
        end = {
            "state": moved.states.numpy(force=True),
            "robustness": self._marked(robustness),
            "rho": rho.numpy(force=True),
            "satisfied": verdicts.satisfied.numpy(force=True),
        }
        return self._marked(end)

    def _marked(self, values: Info) -> Info:
        """Add the boolean arrays that gymnasium expects to `values`, and return the result.

        For every key `NAME`, the array `_NAME`, (N,), marks the environments for which `NAME` has a value.
        """
        return values | {f"_{name}": self._all for name in values}


def make_vec(
    spec: Path | str,
    num_envs: int = 1,
    system: Path | str | None = None,
    *,
    reward: EpisodeReward = "robustness",
    normalised: bool = False,
    time: bool = True,
    autoreset: AutoresetMode = AutoresetMode.SAME_STEP,
    render_mode: RenderMode | None = None,
) -> SpecVectorEnv:
    """Make many environments of a specification file and a system file.

    By default the system is the one that the specification names. For the other arguments see
    `SpecVectorEnv`.

    Raises:
        UsageError: there is no such file, no system is named, the system has no control, or an argument is
            wrong.
        SpecError, SystemFileError: a file is invalid, or the specification and the system do not fit
            together.
    """
    task = Task.load(spec, system, hint="give `system`")
    task.require_controls()
    return SpecVectorEnv(
        task,
        num_envs,
        reward=reward,
        normalised=normalised,
        time=time,
        autoreset=autoreset,
        render_mode=render_mode,
    )
