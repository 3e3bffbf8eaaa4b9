"""The map of Meng & Fan (2023): rovers between destinations and five charging stations.

The true world for the model of `rover.yaml`. All rovers of a seed share the stations without interaction;
each has its own sequence of destinations and moves by the model's step function. Metres, seconds.

* Of 100 stations drawn as in training, the most distant five (of 1000 random sets of five) are used.
* A rover away from its station chooses among the five whenever it plans, and charges only at the chosen one.
* A destination is reached within .8 m of it. One step later the next one takes its place, so a recorded trace
  has the sample in which it was reached.
* The time to stay at a station is renewed as soon as the rover is away from it.
* A rover with an empty battery continues; the share of time with charge is reported.

A rover's start is in the training set, with enough charge for a straight path to a station.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from stlc.controller.sketch import (
    CHARGE,
    DECIDED,
    GOAL,
    GROUND,
    NOTE,
    WALL,
    deciders,
    numbers,
    plans,
    scale_bar,
    tails,
    violations,
)
from stlc.controller.streams import Streams

STATES = 100  # candidates for the stations and for each rover, drawn as in training
SETS, STATIONS = 1000, 5
POINTS = 101  # checked points of a path
ROUNDING = 1e-6
TAIL = 25  # frames of a visible trail


class Stations:
    """The world of `rover.yaml`; see the module's text.

    Implements `stlc.controller.world.World` and `Choosing`.
    """

    def __init__(self, system: Any, agents: int, generator: torch.Generator) -> None:
        self.system, self.agents, self.generator = system, agents, generator
        self.at = {name: index for index, name in enumerate(system.names)}
        constants = ("size", "w", "vmax", "r_near", "c")
        numbers = (float(system.decl.constants[name][0]) for name in constants)
        self.size, self.side, self.fastest, self.near, self.stay = numbers
        w, half = self.side, self.size / 2
        self.walls = torch.tensor(  # left, bottom, right, top
            [
                (0.0, 0.0, w, w),
                (half - w / 2, self.size - w, half + w / 2, self.size),
                (self.size - w, 0.0, self.size, w),
                (half - w / 4, half - w / 4, half + w / 4, half + w / 4),
            ],
            dtype=torch.float64,
        )

    def reset(self) -> torch.Tensor:
        """Draw new stations and the start of every rover."""
        streams = Streams.of(self.generator, self.agents)
        shared = self.system.sample(STATES, generator=streams.shared, dtype=torch.float64)
        self.places = farthest(shared[:, [self.at["xc"], self.at["yc"]]], streams.shared)
        drawn = streams.states(self.system, STATES)
        self.state = torch.stack([own[self._first(own)] for own in drawn])
        self.list = drawn[..., [self.at["xd"], self.at["yd"]]]
        self.number = torch.zeros(self.agents, dtype=torch.int64)
        self.arrived = torch.zeros(self.agents, dtype=torch.int64)
        self.steps, self.charged, self.way = 0, 0.0, 0.0
        self.crashed = torch.zeros(self.agents, dtype=torch.bool)
        self.mine = torch.cdist(self._place(self.state), self.places).argmin(1)
        self.state = self._told(self.state)
        self.state[:, self.at["tau_s"]] = self.stay
        return self.state

    def options(self) -> torch.Tensor:
        """The states with each station as the chosen one, (agents, 5, n); the present choice first.

        A rover at its station keeps it.
        """
        order = torch.stack([(self.mine + turn) % STATIONS for turn in range(STATIONS)], 1)
        order = torch.where(self._at_station(self.state)[:, None], self.mine[:, None], order)
        options = self.state[:, None].repeat(1, STATIONS, 1)
        options[..., [self.at["xc"], self.at["yc"]]] = self.places[order]
        return options

    def choose(self, pick: torch.Tensor) -> torch.Tensor:
        """Apply the option picked by each rover, (agents,); return the states (agents, n)."""
        free = ~self._at_station(self.state)
        self.mine = torch.where(free, (self.mine + pick) % STATIONS, self.mine)
        self.state = self._told(self.state)
        return self.state

    def advance(self, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Advance every rover by one model step; (agents, n), (agents, m) -> (agents, n)."""
        self.state = x
        there = torch.linalg.norm(self._place(x) - self._destination(), dim=1) <= self.near
        moved = self.system.step(x, action)
        self.arrived += there
        self.number = (self.number + there) % STATES
        self._note(self._place(x), moved)
        moved = self._told(moved)
        moved[:, self.at["tau_s"]] = torch.where(
            self._at_station(moved), moved[:, self.at["tau_s"]], torch.full_like(moved[:, 0], self.stay)
        )
        self.state = moved
        return moved

    def progress(self) -> Mapping[str, float]:
        """Mean destinations reached and path length; share of time with charge; number of crashed rovers."""
        return {
            "destinations_reached": float(self.arrived.double().mean()),
            "distance": self.way / self.agents,
            "share_with_charge": self.charged / max(self.steps * self.agents, 1),
            "rovers_crashed": float(self.crashed.sum()),
        }

    def units(self) -> Mapping[str, str]:
        """Units of the entries of `progress`."""
        return {"distance": "m"}

    def snapshot(self) -> Mapping[str, np.ndarray]:
        """Rovers, destinations (agents, 2), stations (5, 2), walls (4, 4), size and radius (2,)."""
        return {
            "rovers": self._place(self.state).numpy(),
            "destinations": self.state[:, [self.at["xd"], self.at["yd"]]].numpy(),
            "battery": self.state[:, self.at["tau_b"]].numpy(),
            "stations": self.places.numpy(),
            "walls": self.walls.numpy(),
            "shape": np.array([self.size, self.near]),
        }

    def charted(self, states: torch.Tensor) -> np.ndarray:
        """Planned states (agents, k, n) as places (agents, k, 2)."""
        return self._place(states).numpy()

    KEYS: ClassVar = {"destination": GOAL, "charging station": CHARGE, "wall": WALL, "battery left": NOTE}

    @staticmethod
    def draw(axes: Any, scene: Mapping[str, np.ndarray], index: int) -> None:
        """One frame: the map; rovers with path, charge and destination, coloured by decision source."""
        from matplotlib.patches import Arc, Circle, Rectangle

        size, near = scene["shape"][index]
        ground = axes.add_patch(Rectangle((0, 0), size, size, color=GROUND, lw=0))
        for left, bottom, right, top in scene["walls"][index]:
            axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, color=WALL, lw=0))
        for place in scene["stations"][index]:
            axes.add_patch(Circle(place, near, color=CHARGE, lw=0, alpha=0.8)).set_clip_path(ground)
        rovers, goals = scene["rovers"], scene["destinations"][index]
        tails(axes, rovers, scene, index, frames=TAIL)
        plans(axes, scene, index)
        most = max(float(scene["battery"].max()), 1e-9)
        who = deciders(scene, index, rovers.shape[1])
        for at, goal, left, source in zip(rovers[index], goals, scene["battery"][index], who, strict=True):
            axes.plot(*np.transpose((at, goal)), color=GOAL, lw=0.8, ls=(0, (2, 3)), zorder=2)
            axes.add_patch(Circle(goal, near, fc="none", ec=GOAL, lw=1.4, zorder=2)).set_clip_path(ground)
            axes.add_patch(Circle(at, 0.22, fc=DECIDED[source], ec="white", lw=0.6, zorder=3))
            full = 360 * min(max(left / most, 0.0), 1.0)
            axes.add_patch(Arc(at, 0.62, 0.62, theta1=90 - full, theta2=90, color=NOTE, lw=1.6, zorder=3))
            high = at[1] + (0.4 if at[1] + 0.8 < size else -0.65)  # on the map
            axes.text(at[0], high, f"{left:.1f} s", size=7.5, ha="center", color=NOTE, zorder=4)
        numbers(axes, rovers[index])
        violations(axes, rovers[index], scene, index)
        scale_bar(axes, size - 2, -0.45, 2)
        axes.set(xlim=(-0.1, size + 0.1), ylim=(-0.7, size + 0.1), aspect="equal")
        axes.set_axis_off()

    def _first(self, states: torch.Tensor) -> int:
        """Index of the first drawn state (k, n) with enough charge for a straight path to a station."""
        apart = torch.cdist(self._place(states), self.places).amin(1) - self.near
        lasts = torch.nonzero(apart <= self.fastest * states[:, self.at["tau_b"]])
        return int(lasts[0]) if len(lasts) else int(states[:, self.at["tau_b"]].argmax())

    def _told(self, states: torch.Tensor) -> torch.Tensor:
        """States with the observation of destination and station."""
        states = states.clone()
        states[:, [self.at["xd"], self.at["yd"]]] = self._destination()
        states[:, [self.at["xc"], self.at["yc"]]] = self.places[self.mine]
        return states

    def _destination(self) -> torch.Tensor:
        return self.list[torch.arange(self.agents), self.number]

    def _place(self, states: torch.Tensor) -> torch.Tensor:
        return states[..., [self.at["x"], self.at["y"]]]

    def _at_station(self, states: torch.Tensor) -> torch.Tensor:
        """Mask of rovers at their chosen station, boundary included, (agents,)."""
        return torch.linalg.norm(self._place(states) - self.places[self.mine], dim=1) <= self.near + ROUNDING

    def _note(self, start: torch.Tensor, moved: torch.Tensor) -> None:
        """Update the metrics for a step from `start` (agents, 2): path length, collisions and charge."""
        end, self.steps = self._place(moved), self.steps + 1
        self.way += float(torch.linalg.norm(end - start, dim=1).sum())
        self.charged += float((moved[:, self.at["tau_b"]] >= -ROUNDING).sum())
        share = torch.linspace(0.0, 1.0, POINTS, dtype=torch.float64)[:, None, None]
        points = (start + share * (end - start))[:, :, None]  # (points, agents, 1, 2)
        inside = ((points > self.walls[:, :2]) & (points < self.walls[:, 2:])).all(3).any(2)
        outside = ((end < 0.0) | (end > self.size)).any(1)
        self.crashed |= inside.any(0) | outside


def farthest(places: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """The set of five places, of `SETS` random ones from (k, 2), with the largest mean distance: (5, 2)."""
    picks = torch.randint(len(places), (SETS, STATIONS), generator=generator)
    apart = torch.cdist(places[picks], places[picks]).sum((1, 2))
    return places[picks[apart.argmax()]]
