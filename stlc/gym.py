"""Any specification and system as a `gymnasium` environment, for whoever trains policies by other means.

The reward is the robustness of what has been driven, so that a policy that maximises it satisfies the
specification. Needs the extra `stlc[gym]`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.graph import evaluate
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.semantics import TOLERANCE
from stlc.controller.task import Task
from stlc.controller.world import world_type
from stlc.controller.worlds import Setting, Worlds
from stlc.diagnostics import Diagnostic, UsageError
from stlc.dynamics.system import System
from stlc.files import find_spec, find_system, read_source
from stlc.grammar.parser import parse

try:
    import gymnasium
except ModuleNotFoundError:
    message = "stlc.gym needs gymnasium, which is not installed: pip install 'stlc[gym]'"
    raise ModuleNotFoundError(message, name="gymnasium") from None

Reward: TypeAlias = Literal["dense", "sparse"]
Observation: TypeAlias = NDArray[np.float32]

MOST = 10.0
"""Robustness beyond this, either way, is no better or worse: it may be infinite."""


class SpecEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One agent in the world of a system, rewarded by the robustness of a specification.

    An observation is what the system's policy observes, (k,) float32; an action is one control in physical
    units, (m,) float32, clipped to its range. `info` holds `state` (n,) float64, `robustness` by
    requirement, `rho` of the whole, and `satisfied`. Robustness is that of the last horizon, of as much of
    it as there is (`end = "truncate"`).

    Args:
        task: specification and system.
        steps: of an episode; by default the horizon of a plan, after which the episode is *terminated*.
            A longer one goes on in the world of the system and is *truncated*.
        reward: "dense" gives what each step adds to the robustness, which sums to that of the episode less
            that of its start; "sparse" gives all of it with the last step.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    def __init__(self, task: Task, *, steps: int | None = None, reward: Reward = "dense") -> None:
        if reward not in ("dense", "sparse"):
            finding = Diagnostic("U101", f"there is no reward `{reward}`", help=("dense or sparse",))
            raise UsageError(finding)
        self.task = task
        self.steps = steps or task.horizon
        self.reward = reward
        low, high = (bound.numpy() for bound in (task.system.control_low, task.system.control_high))
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        shape = (task.system.observed_count,)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, dtype=np.float32)
        self._formulas = [rule.formula for rule in task.rules]
        self._make = world_type(task.system.decl)
        self._worlds: Worlds | None = None
        self._driven: list[Tensor] = []
        self._rho = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A fresh world. The same seed gives the same episode.

        Args:
            seed: of everything random from here on.
            options: `state`, (n,), begins there instead of where the world would.
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
        """One step of the world under `action`, (m,)."""
        if self._worlds is None or len(self._driven) > self.steps:
            raise UsageError(Diagnostic("U101", "the episode is over", help=("call `reset` first",)))
        held = np.clip(action, self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]
        u = torch.as_tensor(held, dtype=torch.float64).reshape(1, -1)
        self._driven.append(self._worlds.advance(self._driven[-1], u, len(self._driven)))
        info, over = self._judged(), len(self._driven) > self.steps
        earned = info["rho"] - self._rho if self.reward == "dense" else info["rho"] * over
        self._rho = info["rho"]
        whole = self.steps <= self.task.horizon
        return self._seen(), float(earned), over and whole, over and not whole, info

    def _seen(self) -> Observation:
        assert self._worlds is not None
        x = self._worlds.disturbance.seen(self._driven[-1], len(self._driven) - 1)
        observed: Observation = self.task.system.observe(x)[0].to(torch.float32).numpy(force=True)
        return observed

    def _judged(self) -> dict[str, Any]:
        """What the last horizon of the episode is worth, or as much of it as there is."""
        driven = torch.cat(self._driven[-self.task.horizon - 1 :]).numpy(force=True)
        columns = {name: driven[:, i, None] for i, name in enumerate(self.task.names)}
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


def make(
    spec: Path | str, system: Path | str | None = None, *, steps: int | None = None, reward: Reward = "dense"
) -> SpecEnv:
    """The environment of a specification's file and of a system's, which the specification may name itself.

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
    return SpecEnv(Task.of(parsed, found), steps=steps, reward=reward)
