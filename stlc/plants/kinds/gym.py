"""Gymnasium environments as plants.

Outputs are components of the observation (`obs[0]`, in order unless `from` says otherwise), components of the
state (`state[0]`), `reward` and `terminated`. Inputs are components of the action (`action[0]`). Start values
are components of the attribute `state` of the environment, and parameters are its attributes, such as `g`. An
environment that terminates ends the simulation.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from stlc.dynamics.declaration.schema.record import TEXT, key, raw
from stlc.extras import needed
from stlc.plants.kind import FaultError, Floats, Layout, PlantKind, Port, UnfitError

_PLACE = re.compile(r"(?P<name>obs|state|action)\[(?P<index>\d{1,6})\]")
_FIRST = {"output": "obs[{}]", "input": "action[{}]", "initial": "state[{}]"}
"""Section -> name in the environment of its i-th entry."""


@dataclass(frozen=True, slots=True)
class GymKeys:
    """The keys of `gym` in a plant file."""

    id: str | None = key(
        TEXT, "name of the environment, such as `Pendulum-v1` or `module:Name-v0`", required=True
    )
    options: Mapping[str, Any] = key(raw({"type": "object"}), "keyword arguments of `gymnasium.make`", {})


def open_gym(layout: Layout) -> GymEnvironment:
    """Make the environment. Raises UnfitError if there is none of this name, or it lacks a port."""
    gymnasium = needed("gymnasium")
    sys.path.insert(0, layout.folder)
    name = str(layout.options["id"])
    try:
        # without a limit of steps: the plant file says how long a simulation is
        environment = gymnasium.make(
            name, max_episode_steps=-1, disable_env_checker=True, **layout.options.get("options", {})
        )
    except Exception as error:
        raise UnfitError(f"`{name}` cannot be made: {type(error).__name__}: {error}") from error
    return GymEnvironment(environment, gymnasium.spaces, layout)


@final
class GymEnvironment:
    """A plant that is a gymnasium environment."""

    def __init__(self, environment: Any, spaces: Any, layout: Layout) -> None:
        self.units: dict[str, str] = {}
        self.ended = False
        self._environment, self._spaces, self._layout = environment, spaces, layout
        self._sizes = {
            "obs": spaces.flatdim(environment.observation_space),
            "action": self._actions(environment.action_space),
            "state": np.size(self._start(0)[1]),
        }
        for section, ports in (
            ("output", layout.outputs),
            ("input", layout.inputs),
            ("initial", layout.initial),
        ):
            for port in ports:
                self._require(port, section)
        self._read = {port.source.partition("[")[0] for port in layout.outputs}
        for port in layout.param:
            if not isinstance(getattr(environment.unwrapped, port.source, None), (int, float, np.number)):
                message = f"the environment has no number `{port.source}` among its attributes"
                raise UnfitError(message, f"param.{port.name}")
        if len(layout.inputs) != self._sizes["action"]:
            given = f"the plant file has {len(layout.inputs)} inputs"
            raise UnfitError(f"an action has {self._sizes['action']} components, {given}", "input")

    def _actions(self, space: Any) -> int:
        if isinstance(space, self._spaces.Discrete):
            return 1
        if isinstance(space, self._spaces.Box):
            return int(np.prod(space.shape))
        raise UnfitError(f"actions of the kind {type(space).__name__} are not numbers")

    def _require(self, port: Port, section: str) -> None:
        allowed = {"output": ("obs", "state"), "input": ("action",), "initial": ("state",)}[section]
        if section == "output" and port.source in ("reward", "terminated"):
            return
        match = _PLACE.fullmatch(port.source)
        if match is None or match["name"] not in allowed or int(match["index"]) >= self._sizes[match["name"]]:
            ends = [
                f"`{name}[0]` to `{name}[{self._sizes[name] - 1}]`" for name in allowed if self._sizes[name]
            ]
            ends += ["`reward`", "`terminated`"] if section == "output" else []
            message = f"the environment has no `{port.source}`; it has {', '.join(ends) or 'none'}"
            raise UnfitError(message, f"{section}.{port.name}")

    def _start(self, seed: int) -> tuple[Any, Any]:
        """Reset the environment; return its observation and its state."""
        observation, _ = self._environment.reset(seed=seed)
        state = getattr(self._environment.unwrapped, "state", None)
        return observation, () if state is None else state

    def start(self, initial: Floats, param: Floats, _inputs: Floats, seed: int) -> Floats:
        """Reset the environment with a seed, then set its parameters and its state."""
        inner = self._environment.unwrapped
        for port, value in zip(self._layout.param, param, strict=True):
            setattr(inner, port.source, float(value))
        observation, before = self._start(seed)
        self.ended = False
        if len(initial):
            state = np.array(before, dtype=np.float64)
            for port, value in zip(self._layout.initial, initial, strict=True):
                match = _PLACE.fullmatch(port.source)
                assert match is not None
                state.reshape(-1)[int(match["index"])] = value
            inner.state = state
            observation = inner._get_obs() if hasattr(inner, "_get_obs") else state
        return self._outputs(observation, 0.0, terminated=False)

    def step(self, inputs: Floats) -> Floats:
        """Take the inputs as an action."""
        space = self._environment.action_space
        if isinstance(space, self._spaces.Discrete):
            action: Any = int(np.rint(inputs[0]))
            if not space.contains(action):
                raise FaultError("error", f"{inputs[0]:g} is no action of {space}")
        else:
            action = inputs.reshape(space.shape).astype(space.dtype)
        observation, reward, terminated, truncated, _ = self._environment.step(action)
        self.ended = bool(terminated or truncated)
        return self._outputs(observation, float(reward), terminated=bool(terminated))

    def _outputs(self, observation: Any, reward: float, *, terminated: bool) -> Floats:
        parts = {}
        if "obs" in self._read:
            parts["obs"] = self._spaces.flatten(self._environment.observation_space, observation)
        if "state" in self._read:
            parts["state"] = getattr(self._environment.unwrapped, "state", ())
        parts = {name: np.asarray(numbers, dtype=np.float64).reshape(-1) for name, numbers in parts.items()}
        single = {"reward": reward, "terminated": float(terminated)}
        found = np.empty(len(self._layout.outputs))
        for index, port in enumerate(self._layout.outputs):
            match = _PLACE.fullmatch(port.source)
            if match is None:
                found[index] = single[port.source]
                continue
            values, at = parts[match["name"]], int(match["index"])
            if at >= len(values):
                raise FaultError("wrong shape", f"`{match['name']}` has {len(values)} components")
            found[index] = values[at]
        return found


def _source(section: str, index: int, name: str) -> str:
    return _FIRST[section].format(index) if section in _FIRST else name


def _files(options: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """Return the file of the module that registers the environment, if it is beside the plant file."""
    module, colon, _ = str(options["id"]).partition(":")
    path = folder / f"{module}.py"
    return {path.name: path} if colon and path.is_file() else {}


KIND = PlantKind(GymKeys, "id", open_gym, _source, files=_files, packages=("gymnasium",), own_step=True)
