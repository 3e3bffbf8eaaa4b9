"""Environment with one agent, on the model of a system or in its world (the closed-loop simulation)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting, Worlds
from stlc.controller.problem.environments import MOST, Environments, require_reward, reward_at_end
from stlc.controller.problem.task import Task
from stlc.controller.world import ModelWorld, world_type
from stlc.diagnostics import usage
from stlc.gym.pictures import MODES, Picture, Pictures, RenderMode, snapshot
from stlc.gym.spaces import Floats, initial_state, of_actuators, of_observation

Reward: TypeAlias = Literal["robustness", "accuracy", "task", "dense"]
"""Name of a reward. `dense` rewards add up to the robustness of the episode less that of its first state."""

AHEAD = 64
"""Initial states that are drawn at a time."""


class SpecEnv(gymnasium.Env[Floats, NDArray[np.float32]]):
    """Environment of one agent, rewarded by a specification.

    The agent moves on the model of a system, or in its world (the closed-loop simulation, with disturbances
    and further agents if the system file declares them).

    An observation, (k,) float32, is what the policy observes. If an episode ends by termination (not by
    truncation), by default its elapsed share is the last observed value, because the remaining return depends
    on it. Observations are clipped to finite bounds: the nominal ranges of the states and the ranges that
    random plans reach, widened by half. An action is the actuator command, (m,) float32, in physical units,
    clipped to the actuator's range. `info` holds `state`, (n,) float64. After the last step, and with the
    reward `dense` after each step, it also holds `robustness` per requirement, `rho` of the whole
    specification, and `satisfied`. Robustness is computed from the last T steps of the episode, where T is
    the number of steps of a plan, and clipped to ±10; NaN counts as -10. While the episode is shorter than T
    steps, the time windows of formulas are cut off at its last sample.

    Args:
        task: specification and system.
        steps: number of steps of an episode; by default the horizon of a plan, after which the episode is
            *terminated*. A longer episode continues in the world of the system and is *truncated*.
        reward: `robustness` of the episode, or `accuracy` (100 if the episode satisfies the specification,
            else 0), given with the last step; `task`, the reward of each step that the system file declares;
            or `dense`, the increase of the robustness in each step.
        normalised: whether observations and actions are scaled to [-1, 1], which most learners expect.
        time: whether the elapsed share of the episode is observed; None: only if the episode terminates.
        world: whether the agent moves in the world of the system; None: only in longer episodes.
        render_mode: `rgb_array`: `render` returns pictures, drawn by the world, or of the agent in the plane
            of its first two states.

    A copy (`copy.deepcopy`) or a pickle continues the episode; the task is shared by copies.

    Raises UsageError (U101) if no reward is named `reward`, if it is `task` and the system declares no
    reward, or if `world` is False for an episode longer than a plan.
    """

    metadata = {"render_modes": MODES}  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        task: Task,
        *,
        steps: int | None = None,
        reward: Reward = "robustness",
        normalised: bool = False,
        time: bool | None = None,
        world: bool | None = None,
        render_mode: RenderMode | None = None,
    ) -> None:
        if reward not in get_args(Reward):
            raise usage(f"there is no reward `{reward}`", f"rewards: {', '.join(get_args(Reward))}")
        if reward != "dense":
            require_reward(task, reward)
        self.task, self.reward, self.normalised = task, reward, normalised
        self.steps = steps or task.horizon
        self.time = self.steps <= task.horizon if time is None else time
        if world is False and self.steps > task.horizon:
            raise usage(
                f"an episode on the model has at most {task.horizon} steps", "take a world: world=True"
            )
        self._actuators, self._bounds = of_actuators(task), of_observation(task, time=self.time)
        self.action_space = self._actuators.space(unit=normalised)
        self.observation_space = self._bounds.space(unit=normalised)
        self._formulas = [rule.formula for rule in task.rules]
        in_world = self.steps > task.horizon if world is None else world
        self._motion = _InWorld(task, self.steps) if in_world else _OnModel(task)
        self.render_mode, dt = render_mode, task.system.dt
        self.metadata = {"render_modes": MODES, "render_fps": max(round(1.0 / dt), 1)}
        self._pictures = Pictures(render_mode, self._motion.draw, dt)
        self._driven: list[Tensor] = []
        self._seeded = False
        self._rho = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode. A seed determines the random numbers of this episode and of all later ones.

        Args:
            seed: seed of all random numbers from this episode on; None: the random numbers continue.
            options: `state`, (n,): an initial state instead of a random one.

        Returns:
            The first observation, and `info`.
        """
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            self._motion.seed(int(self.np_random.integers(2**62)))
            self._seeded = True
        given = (options or {}).get("state")
        x = self._motion.begin(None if given is None else initial_state(self.task, given, 1))
        self._driven = [x]
        self._pictured(first=True)
        info = self._told(judged=self.reward == "dense")
        self._rho = info.get("rho", 0.0)
        return self._seen(), info

    def step(self, action: NDArray[np.float32]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Advance by one step under the action `action`, (m,).

        Returns:
            Observation, reward, whether the episode terminated, whether it was truncated, and `info`.
        """
        if not 0 < len(self._driven) <= self.steps:
            raise usage("the episode is over", "call `reset` first")
        held = self._actuators.physical(action, unit=self.normalised)
        x, u = self._driven[-1], torch.as_tensor(held).reshape(1, -1)
        plan = self.task.system.planned(x, u)
        self._driven.append(self._motion.advance(x, plan, len(self._driven)))
        self._pictured(first=False)
        over = len(self._driven) > self.steps
        info = self._told(judged=over or self.reward == "dense")
        whole = self.steps <= self.task.horizon
        return self._seen(), self._earned(x, plan, info), over and whole, over and not whole, info

    def render(self) -> Picture:
        """Picture of the present instant, (height, width, 3) uint8.

        Raises UsageError (U101) if the environment was made without `render_mode`, or before `reset`.
        """
        return self._pictures.shown()

    def _pictured(self, *, first: bool) -> None:
        if self.render_mode is not None:
            self._pictures.add(self._motion.snapshot(), first=first)

    def _earned(self, before: Tensor, plan: Tensor, info: Mapping[str, Any]) -> float:
        """Reward of the last step, from the state `before`, (1, n), under the controls `plan`, (1, m).

        `info`: info after the step; its entry `rho`, if present, is the robustness of the episode.
        """
        if self.reward == "dense":
            earned, self._rho = info["rho"] - self._rho, info["rho"]
            return float(earned)
        system, earned = self.task.system, 0.0
        if self.reward == "task":
            earned = float(system.reward(self._driven[-1], system.commanded(before, plan)))
        if "rho" in info:
            earned += float(reward_at_end(self.reward, torch.tensor([info["rho"]], dtype=torch.float64)))
        return earned

    def _seen(self) -> Floats:
        step = len(self._driven) - 1
        seen = self.task.system.observe(self._motion.seen(self._driven[-1], step))[0].numpy(force=True)
        values = np.append(seen, step / self.steps) if self.time else seen
        return self._bounds.shown(values.astype(np.float32), unit=self.normalised)

    def _told(self, *, judged: bool) -> dict[str, Any]:
        """Info after a step: the state and, if `judged`, the robustness of the last T steps.

        T is the number of steps of a plan. While the episode is shorter, the time windows of formulas are cut
        off at its last sample.
        """
        state = {"state": self._driven[-1][0].numpy(force=True).copy()}
        if not judged:
            return state
        driven = torch.cat(self._driven[-self.task.horizon - 1 :]).numpy(force=True)
        columns = {name: driven[:, i, None] for i, name in enumerate(self.task.system.names)}
        margins = evaluate(self._formulas, columns, end="truncate")
        exact = [float(np.broadcast_to(margin, (1, 1))[0, 0]) for margin in margins]
        each = np.clip(np.nan_to_num(exact, nan=-MOST), -MOST, MOST)
        named = zip(self.task.rules, each, strict=True)
        return {
            **state,
            "robustness": {rule.name: float(value) for rule, value in named},
            "rho": float(self.task.graph.overall(torch.as_tensor(each)[None])),
            "satisfied": bool(TOLERANCE.satisfied(each).all()),
        }


class _OnModel:
    """Motion of the agent on the model of the system, without disturbances. States are (1, n) float64."""

    draw = staticmethod(ModelWorld.draw)

    def __init__(self, task: Task) -> None:
        self._episodes = Environments(task, 1, generator=torch.Generator(), ahead=AHEAD)
        self.seed = self._episodes.seed

    def begin(self, state: Tensor | None) -> Tensor:
        """Begin an episode at `state`, or at a random state if None; return the initial state."""
        self._episodes.reset(state)
        self._x = self._episodes.states
        return self._x

    def advance(self, _x: Tensor, plan: Tensor, _step: int) -> Tensor:
        """State after step number `step` under the controls `plan`, (1, m)."""
        self._x = self._episodes.step(plan).states
        return self._x

    def snapshot(self) -> Mapping[str, NDArray[Any]]:
        """Arrays from which a picture of the present instant is drawn, name -> array."""
        return snapshot(self._episodes.task, self._x)

    def seen(self, x: Tensor, _step: int) -> Tensor:
        """State `x` as the agent measures it at `step`, with sensor noise if there is any."""
        return x


class _InWorld:
    """Motion of the agent in the world of the system (closed-loop simulation), a new one in each episode.

    It has the methods of `_OnModel`.
    """

    def __init__(self, task: Task, steps: int) -> None:
        self._task, self._steps, self._type = task, steps, world_type(task.system.decl)
        self.draw = self._type.draw
        self._random = np.random.default_rng()

    def __reduce__(self) -> tuple[Any, ...]:
        """Make the motion anew first, which loads the file of its world."""
        return _InWorld, (self._task, self._steps), vars(self)

    def snapshot(self) -> Mapping[str, NDArray[Any]]:
        return self._worlds.snapshot()

    def seed(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def begin(self, state: Tensor | None) -> Tensor:
        seeds = (int(self._random.integers(2**62)),)
        self._worlds = Worlds(self._task, self._type, Setting(seeds, 1, self._steps))
        x = self._worlds.reset()
        return x if state is None else state

    def advance(self, x: Tensor, plan: Tensor, step: int) -> Tensor:
        return self._worlds.advance(x, plan, step)

    def seen(self, x: Tensor, step: int) -> Tensor:
        return self._worlds.disturbance.seen(x, step)


def make(
    spec: Path | str,
    system: Path | str | None = None,
    *,
    steps: int | None = None,
    reward: Reward = "robustness",
    normalised: bool = False,
    time: bool | None = None,
    world: bool | None = None,
    render_mode: RenderMode | None = None,
) -> SpecEnv:
    """Make the environment of a specification file and a system file.

    By default the system is the one that the specification names. For the other arguments see `SpecEnv`.

    Raises:
        UsageError: there is no such file, no system is named, the system has no control, or an argument is
            wrong.
        SpecError, SystemFileError: a file is invalid, or the specification and the system do not fit
            together.
    """
    task = Task.load(spec, system, hint="give `system`")
    task.require_controls()
    return SpecEnv(
        task,
        steps=steps,
        reward=reward,
        normalised=normalised,
        time=time,
        world=world,
        render_mode=render_mode,
    )
