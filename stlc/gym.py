"""A specification and a system as a `gymnasium` environment, for training by other libraries.

The reward is the robustness of the closed-loop run; a policy that maximises it satisfies the specification.
Needs the extra `stlc[gym]`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.analysis.ranges import bounds
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.deployment.batched import Setting, Worlds
from stlc.controller.problem.task import Task
from stlc.controller.world import world_type
from stlc.diagnostics import Diagnostic, UsageError
from stlc.dynamics.model.system import System
from stlc.files import find_spec, find_system, read_source
from stlc.grammar.parse.parser import parse

try:
    import gymnasium
except ModuleNotFoundError:
    message = "stlc.gym needs gymnasium, which is not installed: pip install 'stlc[gym]'"
    raise ModuleNotFoundError(message, name="gymnasium") from None

Reward: TypeAlias = Literal["dense", "sparse"]
Observation: TypeAlias = NDArray[np.float32]

MOST = 10.0
"""Bound to which the robustness, which may be infinite, is clipped on both sides."""


class SpecEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Environment of one agent in the world of a system, rewarded by the robustness of a specification.

    An observation is the policy's observation, (k,) float32, followed by the elapsed share of the episode if
    the episode terminates at its end (the remaining return depends on it). Observations are clipped to finite
    bounds: those of the states' nominal ranges and of random plans, widened by half. An action is the control
    input, (m,) float32, in physical units, clipped to their range. `info` holds `state` (n,) float64,
    `robustness` by requirement, `rho` of the whole, and `satisfied`. Robustness is that of the last horizon,
    of as much of it as there is (`end = "truncate"`).

    Args:
        task: specification and system.
        steps: of an episode; by default the horizon of a plan, after which the episode is *terminated*. A
            longer one continues in the world of the system and is *truncated*.
        reward: "dense" is the increase of the robustness in each step, which sums to that of the episode less
            that of its start; "sparse" is the robustness of the episode, at its last step.
        normalised: observations and actions are from -1 to 1, which most learners expect.
        time: whether the elapsed share of the episode is observed; None: only if the episode terminates.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        task: Task,
        *,
        steps: int | None = None,
        reward: Reward = "dense",
        normalised: bool = False,
        time: bool | None = None,
    ) -> None:
        if reward not in ("dense", "sparse"):
            finding = Diagnostic("U101", f"there is no reward `{reward}`", help=("dense or sparse",))
            raise UsageError(finding)
        self.task = task
        self.steps = steps or task.horizon
        self.reward = reward
        self.normalised = normalised
        self.time = self.steps <= task.horizon if time is None else time
        self._actuators = _Box.of(task.system.actuators)
        self._observed = _observed(task, time=self.time)
        self.action_space = self._actuators.space(unit=normalised)
        self.observation_space = self._observed.space(unit=normalised)
        self._formulas = [rule.formula for rule in task.rules]
        self._make = world_type(task.system.decl)
        self._worlds: Worlds | None = None
        self._driven: list[Tensor] = []
        self._rho = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset the world. The same seed gives the same episode.

        Args:
            seed: of all random numbers from here on.
            options: `state`, (n,), an initial state in place of the world's own.
        """
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**62))
        self._worlds = Worlds(self.task, self._make, Setting((drawn,), 1, self.steps))
        x = self._worlds.reset()
        if options and "state" in options:
            x = torch.as_tensor(np.asarray(options["state"], dtype=np.float64)).reshape(1, -1)
        self._driven = [x]
        info = self._judged()
        self._rho = info["rho"]
        return self._seen(), info

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance the world by one step under `action`, (m,)."""
        if self._worlds is None or len(self._driven) > self.steps:
            raise UsageError(Diagnostic("U101", "the episode is over", help=("call `reset` first",)))
        held = self._actuators.clipped(action, unit=self.normalised)
        x, u = self._driven[-1], torch.as_tensor(held, dtype=torch.float64).reshape(1, -1)
        self._driven.append(self._worlds.advance(x, self.task.system.planned(x, u), len(self._driven)))
        info, over = self._judged(), len(self._driven) > self.steps
        earned = info["rho"] - self._rho if self.reward == "dense" else info["rho"] * over
        self._rho = info["rho"]
        whole = self.steps <= self.task.horizon
        return self._seen(), float(earned), over and whole, over and not whole, info

    def _seen(self) -> Observation:
        assert self._worlds is not None
        step = len(self._driven) - 1
        x = self._worlds.disturbance.seen(self._driven[-1], step)
        seen = self.task.system.observe(x)[0].numpy(force=True)
        if self.time:
            seen = np.append(seen, step / self.steps)
        return self._observed.told(seen, unit=self.normalised)

    def _judged(self) -> dict[str, Any]:
        """Robustness of the last horizon of the episode, truncated if the episode is shorter."""
        driven = torch.cat(self._driven[-self.task.horizon - 1 :]).numpy(force=True)
        columns = {name: driven[:, i, None] for i, name in enumerate(self.task.system.names)}
        margins = evaluate(self._formulas, columns, ops=NUMPY, end="truncate")
        each = np.clip([float(np.broadcast_to(margin, (1, 1))[0, 0]) for margin in margins], -MOST, MOST)
        rho = float(self.task.graph.overall(torch.as_tensor(each)[None]))
        return {
            "state": driven[-1].copy(),
            "robustness": {
                rule.name: float(value) for rule, value in zip(self.task.rules, each, strict=True)
            },
            "rho": rho,
            "satisfied": bool((each >= -TOLERANCE).all()),
        }


@dataclass(frozen=True, slots=True)
class _Box:
    """Bounds of a space, (k,) float32, with normalisation to [-1, 1]."""

    low: Observation
    high: Observation

    @classmethod
    def of(cls, ranges: Sequence[tuple[float, float]]) -> _Box:
        ends = np.array(ranges, dtype=np.float32).reshape(-1, 2)
        return cls(ends[:, 0], ends[:, 1])

    def space(self, *, unit: bool) -> Any:
        if unit:
            return gymnasium.spaces.Box(-1.0, 1.0, self.low.shape, dtype=np.float32)
        return gymnasium.spaces.Box(self.low, self.high, dtype=np.float32)

    def clipped(self, given: NDArray[np.float32], *, unit: bool) -> NDArray[np.float64]:
        """Clip `given` to the bounds, in physical units; with `unit` it is normalised."""
        low, high = self.low.astype(np.float64), self.high.astype(np.float64)
        value = np.asarray(given, dtype=np.float64)
        return np.clip(low + 0.5 * (value + 1.0) * (high - low) if unit else value, low, high)

    def told(self, value: NDArray[np.float64], *, unit: bool) -> Observation:
        """The (normalised) value of the space for a physical value."""
        if unit:
            wide = (self.high - self.low).astype(np.float64)
            value = 2.0 * (value - self.low) / wide - 1.0
            return np.clip(value, -1.0, 1.0).astype(np.float32)
        return np.clip(value, self.low, self.high).astype(np.float32)


PROBED = 256
"""Random plans whose observations widen the bounds of the space."""


def _observed(task: Task, *, time: bool) -> _Box:
    """Bounds of the policy's observation: nominal ranges, or those of random plans, widened."""
    system = task.system
    generator = torch.Generator().manual_seed(0)
    x0 = task.sample(PROBED, seed=0, dtype=torch.float64)
    low, high = system.control_low.double(), system.control_high.double()
    shape = (PROBED, task.horizon, len(low))
    plans = low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)
    seen = system.observe(system.rollout(x0, plans)).flatten(0, 1)
    facts = {
        each.name: (each.low, each.high)
        for each in system.signature.columns
        if each.low is not None and each.high is not None
    }
    observe = system.decl.policy.observe
    names = [column.name for column in system.added] if observe else list(system.names)
    numbers = [*observe, *(ir.Signal(name) for name in names)]
    found = []
    for number, column in zip(numbers, seen.unbind(1), strict=True):
        ends = bounds(number, facts) or (math.inf, -math.inf)
        least, most = min(ends[0], float(column.min())), max(ends[1], float(column.max()))
        if not math.isfinite(most - least):
            least, most = float(column.min()), float(column.max())
        wider = 0.25 * max(most - least, 1e-3)
        found.append((least - wider, most + wider))
    return _Box.of([*found, *([(0.0, 1.0)] if time else [])])


def make(
    spec: Path | str,
    system: Path | str | None = None,
    *,
    steps: int | None = None,
    reward: Reward = "dense",
    normalised: bool = False,
    time: bool | None = None,
) -> SpecEnv:
    """Make the environment of a specification file and a system file (default: the one the former names).

    The other arguments are those of `SpecEnv`.

    Raises:
        UsageError: there is no such file, or no system is named.
        SpecError, SystemFileError: a file is invalid, or they do not fit.
    """
    path = find_spec(spec)
    parsed = parse(read_source(path))
    named = system or parsed.system
    if named is None:
        raise UsageError(Diagnostic("U101", f"`{spec}` names no system", help=("give one",)))
    found = System.load(find_system(str(named), None if system else path))
    task = Task.of(parsed, found)
    return SpecEnv(task, steps=steps, reward=reward, normalised=normalised, time=time)
