"""The world of a deployment: the true environment, with effects that the policy's model lacks.

A system file names a world as `test: {world: "traffic_grid.py:TrafficGrid"}`: a class in a Python file beside
it, imported only when the system is deployed. Without a world, independent agents follow the model and are
subject to the `events` of the system file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.controller.sketch import DECIDED, Scene, deciders
from stlc.diagnostics import RunError, SystemFileError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.deployment import WorldRef
from stlc.dynamics.system import System
from stlc.dynamics.uncertainty.disturbance import Events
from stlc.foreign import module_at


class World(Protocol):
    """True environment of the agents, with effects that the model lacks.

    States are float64 and contain neither the timers nor the parameters that a specification adds.
    """

    def reset(self) -> Tensor:
        """Begin a simulation and return the initial states, (agents, n)."""

    def advance(self, x: Tensor, action: Tensor) -> Tensor:
        """Advance by one true step: states (agents, n), actions (agents, m) -> next states (agents, n)."""

    def progress(self) -> Mapping[str, float]:
        """Progress of the task since `reset`, name -> number."""

    def snapshot(self) -> Scene:
        """Arrays from which a picture of this instant is drawn; their shapes are the same at every step.

        Arrays with an entry per agent have the agents as first dimension: (agents, …).
        """

    def units(self) -> Mapping[str, str]:
        """Unit of each entry of `progress` that has one, name -> unit."""

    @staticmethod
    def draw(axes: Any, scene: Scene, index: int) -> None:
        """Draw frame `index` on matplotlib axes.

        `scene`: snapshots, stacked over time, and `decision`, the source of each agent's plan, (frames,
        agents).
        """


@runtime_checkable
class Choosing(Protocol):
    """World in which agents choose among options, such as the station to go to.

    Agents choose whenever they replan. Each agent takes the option under which its plan is best.
    """

    def options(self) -> Tensor:
        """States that the agents would have under each option, (agents, k, n); option 0 changes nothing."""

    def choose(self, pick: Tensor) -> Tensor:
        """Apply the option with the index in `pick`, (agents,), to each agent; return states (agents, n)."""


@runtime_checkable
class Redrawing(Protocol):
    """World that can draw the initial state of an agent again before the first step."""

    def redraw(self, rows: Tensor) -> Tensor:
        """Draw the initial states of the agents `rows`, (k,) int64, again; return all states, (agents, n).

        The states of other agents change only if they depend on the redrawn ones.
        """


@runtime_checkable
class Charting(Protocol):
    """World that maps planned trajectories to picture coordinates, so that pictures can show them."""

    def charted(self, states: Tensor) -> NDArray[np.float64]:
        """Picture coordinates of planned states: (agents, k, n) -> (agents, k, 2 or 3).

        The first of an agent's k states is its present one. NaN states have NaN coordinates.
        """


class WorldType(Protocol):
    """Interface of world classes: a constructor, and the static method `draw`.

    The world must draw all random numbers from `generator`.
    """

    draw: Callable[[Any, Scene, int], None]

    def __call__(self, system: System, agents: int, generator: torch.Generator) -> World: ...


class ModelWorld:
    """Independent agents that follow the model exactly and are subject to the events of the system file.

    Attributes:
        independent: whether no agent influences another, directly or through random numbers that they share.
            Any world may have this attribute; without it, its agents are not taken to be independent.
    """

    independent: ClassVar[bool] = True

    def __init__(self, system: System, agents: int, generator: torch.Generator) -> None:
        self._system, self._agents, self._generator = system, agents, generator
        self._events = Events(system.decl.test.events, system.names, system.dt)
        self._begin()

    def _begin(self) -> None:
        self._step = 0
        self._counts = {event.name: 0.0 for event in self._system.decl.test.events if event.when is not None}

    def reset(self) -> Tensor:
        """Initial states from the training distribution, (agents, n)."""
        self._begin()
        self._drawn = self._sampled(self._system, self._agents)
        return self._happen(self._drawn)

    def redraw(self, rows: Tensor) -> Tensor:
        """Redraw the initial states of the agents `rows`, (k,), and apply the events of step 0 to all agents.

        Returns all states, (agents, n).
        """
        self._begin()
        self._drawn = self._drawn.index_copy(0, rows, self._sampled(self._system.of_agents(rows), len(rows)))
        return self._happen(self._drawn)

    def advance(self, x: Tensor, action: Tensor) -> Tensor:
        """One step of the model, then the events: (agents, n), (agents, m) -> (agents, n)."""
        moved = self._system.step(x, action)
        self._step += 1
        return self._happen(moved)

    def progress(self) -> Mapping[str, float]:
        """Number of times that each event with a condition happened, summed over all agents."""
        return dict(self._counts)

    def units(self) -> Mapping[str, str]:
        """Empty: counts have no unit."""
        return {}

    def snapshot(self) -> Scene:
        """The states, (agents, n), as `state`, and the names of the states, (n,), as `names`."""
        return {"state": self._x.numpy(force=True), "names": np.array(self._system.names)}

    def charted(self, states: Tensor) -> NDArray[np.float64]:
        """The first two components of planned states: (agents, k, n) -> (agents, k, 2)."""
        return states[..., [0, min(1, states.shape[2] - 1)]].numpy(force=True)

    @staticmethod
    def draw(axes: Any, scene: Scene, index: int) -> None:
        """Draw agents in the plane of the first two states; `scene["state"]` is (frames, agents, n)."""
        names, state = scene["names"][index], scene["state"]
        decided = deciders(scene, index, state.shape[1])
        second = min(1, state.shape[2] - 1)
        for source, color in enumerate(DECIDED):
            points = state[index][decided == source]
            axes.scatter(points[:, 0], points[:, second], s=18, color=color, lw=0)
        for column, limit in ((0, axes.set_xlim), (second, axes.set_ylim)):
            low, high = float(state[..., column].min()), float(state[..., column].max())
            limit(low - 0.05 * (high - low) - 1e-3, high + 0.05 * (high - low) + 1e-3)
        axes.set(xlabel=str(names[0]), ylabel=str(names[second]))

    def _sampled(self, system: System, count: int) -> Tensor:
        return system.sample(count, generator=self._generator, dtype=torch.float64)

    def _happen(self, x: Tensor) -> Tensor:
        self._x, counts = self._events.apply(x, self._step, self._generator)
        for name, count in counts.items():
            self._counts[name] += count
        return self._x


def independent_agents(make: WorldType) -> bool:
    """True if a world class says that no agent influences another; see `ModelWorld.independent`.

    The attribute is not inherited: a world that is derived from an independent one may couple its agents.
    """
    return vars(make).get("independent") is True


_METHODS = ("reset", "advance", "progress", "units", "snapshot", "draw")


def world_type(decl: SystemDecl) -> WorldType:
    """Return the world class that a system file names, else `ModelWorld`.

    Raises:
        SystemFileError: S206, the file or the class cannot be loaded or is not a world.
        RunError: R111, a run names it, and the command does not drive.
    """
    return cast(WorldType, ModelWorld) if decl.test.world is None else _load(decl.test.world)


def _load(reference: WorldRef) -> WorldType:
    path, name = reference.path, reference.name
    try:
        module = module_at(path, f"stlc_world_{path.stem}", reference.span)
    except RunError:
        raise
    except FileNotFoundError as error:
        raise _refused(reference, str(error)) from None
    except Exception as error:
        raise _refused(reference, f"importing `{path}` fails", f"{type(error).__name__}: {error}") from error
    found = getattr(module, name, None)
    if not isinstance(found, type):
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        raise _refused(reference, f"`{path}` has no class `{name}`").near(name, classes)
    missing = [method for method in _METHODS if not callable(getattr(found, method, None))]
    if missing:
        raise _refused(reference, f"`{name}` in `{path}` is no world: it lacks {', '.join(missing)}")
    return cast(WorldType, found)


def _refused(reference: WorldRef, message: str, note: str = "") -> SystemFileError:
    return SystemFileError.of(
        "S206",
        message,
        reference.span,
        label="named here",
        note=(note,) if note else (),
    )
