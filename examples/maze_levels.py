"""The shaft of Meng & Fan (2023): a ball that rises through 200 levels of obstacles and goals.

The true world for the model of `maze.yaml`. Each ball has its own shaft and moves by the model's step
function: it rises at a constant speed and steers sideways. A level is an obstacle with a gap on each side and
perhaps a goal in one of the gaps; level i has its upper edge at height 2.5 i. Metres, seconds.

* Levels are drawn as the next one in training is: width 2 to 4 m, anywhere in the shaft of 5 m, slivers of
  less than .1 m closed; a goal in the left gap, in the right one, or none, where it fits.
* The obstacle of the first level begins .1 m outside of the left wall, so its goal can only be on the right.
* A ball starts at the left wall, at rest, 2.5 m below the first level. It observes the next two levels; above
  the upper edge of a level it moves on to the next one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from stlc.controller.sketch import (
    DECIDED,
    GOAL,
    GROUND,
    NOTE,
    WALL,
    deciders,
    plans,
    scale_bar,
    tails,
    violations,
)
from stlc.controller.streams import Streams

LEVELS = 200
EDGE = -0.1  # left edge of the first obstacle
NONE = -1.0  # this level has no goal
ROUNDING = 1e-9  # heights are sums of steps
BELOW, ABOVE = 3.0, 6.0  # m of the shaft shown around the ball in a picture
ASIDE = 2.3  # m beside each shaft, for the numbers of its levels
TAIL = 20  # frames of a visible trail


class MazeLevels:
    """The world of `maze.yaml`, a `stlc.controller.world.World`; see the module's text."""

    def __init__(self, system: Any, agents: int, generator: torch.Generator) -> None:
        self.system, self.agents, self.generator = system, agents, generator
        self.at = {name: index for index, name in enumerate(system.names)}
        constants = ("width", "h", "d", "r")
        self.width, self.h, self.d, self.r = (float(system.decl.constants[name][0]) for name in constants)

    def reset(self) -> torch.Tensor:
        """Draw new shafts, with a ball at the start of each."""
        self.streams = Streams.of(self.generator, self.agents)
        columns = [self.at[name] for name in ("x1", "l1", "g1")]
        self.levels = self.streams.states(self.system, LEVELS)[..., columns]  # (agents, levels, 3)
        for own, generator in zip(self.levels, self.streams.own, strict=True):
            own[0] = self._first(own[0], generator)
        self.passed = torch.zeros(self.agents, dtype=torch.int64)
        self.inside = torch.zeros(self.agents, dtype=torch.bool)
        self.hits, self.reached = torch.zeros(2, self.agents, dtype=torch.int64)
        self.near = torch.zeros(self.agents, dtype=torch.bool)
        x = torch.zeros(self.agents, len(self.at), dtype=torch.float64)
        x[:, self.at["dy"]] = -self.d
        self.met, self.state = torch.zeros(self.agents, dtype=torch.int64), self._facing(x)
        return self.state

    def advance(self, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Advance every ball by one model step; (agents, n), (agents, m) -> (agents, n)."""
        moved, dy = self.system.step(x, action), self.at["dy"]
        self._look(moved)
        above = moved[:, dy] > ROUNDING
        moved[:, dy] -= self.d * above
        self._count(above)
        self.passed = (self.passed + above).clamp(max=LEVELS - 2)
        self.state = self._facing(moved)
        return self.state

    def progress(self) -> Mapping[str, float]:
        """Means over the balls: levels passed, obstacles touched on the way, goals met and reached."""
        each = {
            "levels_passed": self.passed,
            "obstacles_touched": self.hits,
            "goals_met": self.met,
            "goals_reached": self.reached,
        }
        return {name: float(values.double().mean()) for name, values in each.items()}

    def units(self) -> Mapping[str, str]:
        """Counts have none."""
        return {}

    def snapshot(self) -> Mapping[str, np.ndarray]:
        """Balls (agents, 2) as x and height; levels (agents, levels, 3); their common dimensions (4,)."""
        height = self.state[:, self.at["dy"]] + self.d * (self.passed + 1)
        return {
            "balls": torch.stack((self.state[:, self.at["x"]], height), 1).numpy(),
            "levels": self.levels.numpy(),
            "shape": np.array([self.width, self.h, self.d, self.r]),
        }

    def charted(self, states: torch.Tensor) -> np.ndarray:
        """Planned states (agents, k, n) as x and height, (agents, k, 2)."""
        height = states[..., self.at["dy"]] + self.d * (self.passed[:, None] + 1)
        return torch.stack((states[..., self.at["x"]], height), -1).numpy()

    KEYS: ClassVar = {"goal": GOAL, "obstacle": WALL}

    @staticmethod
    def draw(axes: Any, scene: Mapping[str, np.ndarray], index: int) -> None:
        """One frame: the shafts side by side around their balls, coloured by decision source."""
        from matplotlib.patches import Circle

        balls, (width, high, apart, radius) = scene["balls"], scene["shape"][index]
        pitch = width + ASIDE
        who = deciders(scene, index, balls.shape[1])
        for shaft, own in enumerate(scene["levels"][index]):
            draw_shaft(axes, shaft * pitch, own, balls[index, shaft, 1], (width, high, apart, radius))
        left = pitch * np.arange(balls.shape[1])
        seen = np.stack((balls[..., 0] + left, balls[..., 1] - balls[index, :, 1]), -1)
        tails(axes, np.where(seen[..., 1:] > -BELOW, seen, np.nan), scene, index, frames=TAIL)
        origin = np.stack((left, -balls[index, :, 1]), -1)[:, None]
        plans(axes, scene, index, lambda places: places + origin)
        for at, source in zip(seen[index], who, strict=True):
            axes.add_patch(Circle(at, 0.2, fc=DECIDED[source], ec="white", lw=0.6, zorder=3))
        for shaft, start in enumerate(left):
            axes.text(
                start + width / 2, -BELOW - 0.2, f"ball {shaft}", ha="center", va="top", size=7.5, color=NOTE
            )
        violations(axes, seen[index], scene, index)
        scale_bar(axes, width + 0.3, -BELOW - 0.6, 2)
        axes.set(xlim=(-0.3, len(who) * pitch - 0.1), ylim=(-BELOW - 1.1, ABOVE), aspect="equal")
        axes.set_axis_off()

    def _first(self, level: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Draw the first level: its obstacle leaves a gap only on the right, with or without a goal."""
        edge, length = EDGE, float(level[1])
        coin, share = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        end = edge + length
        goal = end + (self.width - end) * (0.3 + 0.4 * share)
        fits = coin < 0.5 and self.width - goal >= self.r and goal - end >= self.r
        return torch.tensor([edge, length, goal if fits else NONE], dtype=torch.float64)

    def _facing(self, states: torch.Tensor) -> torch.Tensor:
        """States with the observation of the next two levels."""
        rows, states = torch.arange(self.agents), states.clone()
        for offset in (0, 1):
            level = self.levels[rows, self.passed + offset]
            for column, name in enumerate("xlg"):
                states[:, self.at[f"{name}{offset}"]] = level[:, column]
        return states

    def _look(self, states: torch.Tensor) -> None:
        """Update which balls are inside the next obstacle or at its goal, before levels are counted."""
        x, dy = states[:, self.at["x"]], states[:, self.at["dy"]]
        edge, length, goal = self.levels[torch.arange(self.agents), self.passed].unbind(1)
        beside = (x - edge) * (x - edge - length) > 0
        self.inside |= (dy > -self.h + ROUNDING) & (dy < -ROUNDING) & ~beside
        self.near |= (goal > 0) & ((x - goal) ** 2 + (dy + self.h / 2) ** 2 < self.r**2)

    def _count(self, above: torch.Tensor) -> None:
        """Update the counters for the passed levels."""
        goal = self.levels[torch.arange(self.agents), self.passed, 2]
        self.hits += above & self.inside
        self.met += above & (goal > 0)
        self.reached += above & self.near
        self.inside, self.near = self.inside & ~above, self.near & ~above


def draw_shaft(
    axes: Any, left: float, levels: np.ndarray, height: float, shape: tuple[float, float, float, float]
) -> None:
    """Draw a shaft around a height with its levels (k, 3) of a shape: width, height, distance, radius."""
    from matplotlib.patches import Circle, Rectangle

    width, high, apart, radius = shape
    shaft = axes.add_patch(Rectangle((left, -BELOW), width, BELOW + ABOVE, color=GROUND, lw=0))
    for level, (edge, length, goal) in enumerate(levels, start=1):
        top = level * apart - height
        if not -BELOW < top < ABOVE + high:
            continue
        start, end = max(edge, 0.0), min(edge + length, width)
        block = Rectangle((left + start, top - high), end - start, high, color=WALL, lw=0)
        axes.add_patch(block).set_clip_path(shaft)
        axes.text(left + width + 0.3, top - high / 2, f"level {level}", size=6.5, color=NOTE, va="center")
        if goal > 0:
            place = (left + goal, top - high / 2)
            axes.add_patch(Circle(place, radius, fc="none", ec=GOAL, lw=1.6)).set_clip_path(shaft)
