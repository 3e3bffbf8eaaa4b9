"""The rivers of Meng & Fan (2023): ships that pass one obstacle after the other on a river 4 m wide.

The true world for the models of `ship_safe.yaml` and `ship_track.yaml`. All ships of a seed share the river
without interaction; each moves by the model's step function. A ship observes the next obstacle, or the next
two. Metres, seconds.

* `SafeRiver`: an obstacle of radius 1 every 7.5 m. A ship has passed one when it is beside its centre.
* `TrackRiver`: obstacles on the centreline, 15 to 25 m apart. A ship has passed one when it is 1 m ahead of
  its centre. A ship observes an obstacle within 8 m; that renews the allowance: 15 steps if its radius is
  less than .8, 20 if less than 1, else 25.
* `ShiftedRiver`: the paper's test of the backup policy. Obstacles every 12 m, the first 4 m ahead and .25 m
  off the centreline, the others .2 m, the second half as large again, and an allowance of 20 or 25 steps.
  Ships start .3 to 1.8 m off the line, straight ahead at 5 m/s; their allowance ran out 5 steps ago.

Starts satisfy the system file's constraints, also with the river's first obstacle instead of the drawn one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from stlc.controller.sketch import (
    BANK,
    NOTE,
    STONE,
    WATER,
    deciders,
    numbers,
    outlines,
    plans,
    scale_bar,
    tails,
    violations,
)
from stlc.controller.streams import Streams

OBSTACLES = 100
PROPOSED = 64  # starts drawn for a ship, of which the first admissible one is taken
ATTEMPTS = 20  # times that they are drawn at most
SPACING = 7.5  # of SafeRiver
BEHIND = 1.0  # m that a ship of TrackRiver must be ahead of an obstacle
NEAREST, FARTHEST = 15.0, 25.0  # from one obstacle of TrackRiver to the next
ALLOWANCES = ((0.8, 15), (1.0, 20), (math.inf, 25))  # radius less than -> steps
SHIFTED = 20  # obstacles of ShiftedRiver
FOLD = 40.0  # m of river in one row of the picture
WAKE = 14  # frames of a visible trail
HULL = np.array([(0.8, 0.0), (0.35, 0.3), (-0.55, 0.3), (-0.4, 0.0), (-0.55, -0.3), (0.35, -0.3)])  # m


@dataclass(frozen=True, slots=True)
class Chain:
    """The obstacles of a river in order: positions, radii, and allowances (s); (M,) each."""

    x: torch.Tensor
    y: torch.Tensor
    r: torch.Tensor
    allowance: torch.Tensor


class River(ABC):
    """Base class of the three rivers. Implements `stlc.controller.world.World`."""

    def __init__(self, system: Any, agents: int, generator: torch.Generator) -> None:
        self.system, self.agents, self.generator = system, agents, generator
        self.at = {name: index for index, name in enumerate(system.names)}
        self.seen = 2 if "x2" in self.at else 1
        self.half = float(system.decl.constants["D"][0]) / 2

    def reset(self) -> torch.Tensor:
        """Draw a new river and its ships, all at x = 0."""
        self.streams = Streams.of(self.generator, self.agents)
        for _ in range(ATTEMPTS):
            proposed = self._proposed()
            self.first = proposed[0, self._allowed(proposed[0])]
            if len(self.first):
                break
        else:
            raise ValueError("no start of the first ship is admissible")
        self.chain = self._chain()
        self.next = torch.zeros(self.agents, dtype=torch.int64)
        return self._begun(self._starts(proposed, torch.arange(self.agents)))

    def redraw(self, rows: torch.Tensor) -> torch.Tensor:
        """Redraw the starts of ships `rows` (k,) on the same river; return all states, (agents, n)."""
        starts = self._starts(self._proposed()[rows], rows)
        return self._begun(self.state.index_copy(0, rows, starts))

    def advance(self, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Advance every ship by one model step; (agents, n), (agents, m) -> (agents, n)."""
        self.hit |= self._touching(x)
        moved = self.system.step(x, action)
        self.switched = self._passed(moved[:, self.at["x"]], self.chain.x[self.next])
        self.next = (self.next + self.switched).clamp(max=len(self.chain.x) - self.seen)
        self.state = self._facing(moved)
        self.hit |= self._touching(self.state)
        return self.state

    def progress(self) -> Mapping[str, float]:
        """Mean distance and obstacles passed, and number of ships that ever touched an obstacle or a bank."""
        travelled = self.state[:, self.at["x"]] - self.begin
        return {
            "distance": float(travelled.mean()),
            "obstacles_passed": float(self.next.double().mean()),
            "ships_aground": float(self.hit.sum()),
        }

    def units(self) -> Mapping[str, str]:
        """Units of the entries of `progress`."""
        return {"distance": "m"}

    def snapshot(self) -> Mapping[str, np.ndarray]:
        """Ships (agents, 3) as x, y, heading; obstacles (M, 3) as x, y, r; half the width of the river."""
        columns = [self.at[name] for name in ("x", "y", "psi")]
        return {
            "ships": self.state[:, columns].numpy(),
            "obstacles": torch.stack((self.chain.x, self.chain.y, self.chain.r), 1).numpy(),
            "half": np.float64(self.half),
        }

    def charted(self, states: torch.Tensor) -> np.ndarray:
        """Planned states (agents, k, n) as places (agents, k, 2)."""
        return states[..., [self.at["x"], self.at["y"]]].numpy()

    KEYS: ClassVar = {"obstacle": STONE}

    @staticmethod
    def draw(axes: Any, scene: Mapping[str, np.ndarray], index: int) -> None:
        """One frame: the river in rows of 40 m from the top, ships and wakes coloured by decision source."""
        ships, half = scene["ships"], float(scene["half"][index])
        rows, pitch = max(int(ships[..., 0].max() // FOLD) + 1, 2), 2 * half + 1.8
        for row in range(rows):
            draw_row(axes, row, scene["obstacles"][index], half, pitch)

        def folded(places: np.ndarray, axis: int) -> np.ndarray:
            """Positions (..., 2) folded into rows; a line along `axis` is broken between rows."""
            row = np.clip(places[..., 0] // FOLD, 0, rows - 1)
            placed = np.stack((places[..., 0] - row * FOLD, places[..., 1] - row * pitch), -1)
            begin = np.take(row, [0], axis)
            return np.where(np.diff(row, axis=axis, prepend=begin)[..., None] != 0, np.nan, placed)

        tails(axes, folded(ships[..., :2], 0), scene, index, frames=WAKE)
        plans(axes, scene, index, lambda places: folded(places, 1))
        here = folded(ships[index : index + 1, :, :2], 0)[0]
        outlines(axes, HULL, np.c_[here, ships[index, :, 2]], deciders(scene, index, ships.shape[1]))
        numbers(axes, here)
        violations(axes, here, scene, index)
        bottom = -(rows - 0.5) * pitch - 0.9
        scale_bar(axes, FOLD - 5, bottom + 0.3, 5)
        axes.set(xlim=(-3.4, FOLD + 0.5), ylim=(bottom - 0.4, pitch / 2 - 0.5), aspect="equal")
        axes.set_axis_off()

    # ------------------------------------------------------------- differences between rivers

    @abstractmethod
    def _calmed(self, states: torch.Tensor) -> torch.Tensor:
        """Starts (…, n) drawn as in training, adapted to this river."""

    @abstractmethod
    def _chain(self) -> Chain:
        """Draw the obstacles; `self.first` holds possible starts (k, n) of the first ship."""

    @abstractmethod
    def _passed(self, x: torch.Tensor, obstacle: torch.Tensor) -> torch.Tensor:
        """Mask of ships at `x` that have passed obstacles at `obstacle`, (agents,) each."""

    # ------------------------------------------------------------------------------ parts

    def _begun(self, x: torch.Tensor) -> torch.Tensor:
        """Initialise the world with the states (agents, n)."""
        self.begin, self.state, self.hit = x[:, self.at["x"]], x, self._touching(x)
        return x

    def _proposed(self) -> torch.Tensor:
        """Starts drawn for every ship, (agents, PROPOSED, n)."""
        return self._calmed(self.streams.states(self.system, PROPOSED))

    def _starts(self, proposed: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Admissible starts of the ships `rows` (k,) on this river, (k, n).

        Each is the first admissible one of the starts (k, PROPOSED, n), or of starts drawn anew: few starts
        fit in front of a near and large obstacle.
        """
        found = [self._start(own) for own in proposed]
        for _ in range(ATTEMPTS):
            starts = [each for each in found if each is not None]
            if len(starts) == len(found):
                return torch.stack(starts)
            again = self._proposed()[rows]
            found = [self._start(own) if old is None else old for old, own in zip(found, again, strict=True)]
        raise ValueError("no start of a ship fits in front of the first obstacle of the river")

    def _start(self, proposed: torch.Tensor) -> torch.Tensor | None:
        """The first admissible one of the proposed starts (k, n) on this river; None if there is none."""
        placed = self._facing(proposed, torch.zeros(len(proposed), dtype=torch.int64))
        allowed = placed[self._allowed(placed)]
        return allowed[0] if len(allowed) else None

    def _allowed(self, states: torch.Tensor) -> torch.Tensor:
        return self.system.initial.holds(states)

    def _facing(self, states: torch.Tensor, front: torch.Tensor | None = None) -> torch.Tensor:
        """States (k, n) with the observed obstacles of the river, from index `front` (k,) on."""
        front, states = self.next if front is None else front, states.clone()
        for offset in range(self.seen):
            for name, column in (("x", self.chain.x), ("y", self.chain.y), ("r", self.chain.r)):
                states[:, self.at[f"{name}{offset + 1}"]] = column[front + offset]
        return states

    def _touching(self, states: torch.Tensor) -> torch.Tensor:
        """Mask of ships inside any obstacle, or on a bank, (agents,)."""
        x, y = states[:, self.at["x"], None], states[:, self.at["y"], None]
        inside = torch.hypot(x - self.chain.x, y - self.chain.y) < self.chain.r
        return inside.any(1) | (y[:, 0].abs() > self.half)

    def _uniform(self, low: float, high: float, count: int) -> torch.Tensor:
        """Uniform random numbers of the river's generator, (count,)."""
        drawn = torch.rand(count, generator=self.streams.shared, dtype=torch.float64)
        return low + (high - low) * drawn


class SafeRiver(River):
    """The river of `ship_safe.yaml`."""

    def _calmed(self, states: torch.Tensor) -> torch.Tensor:
        return states

    def _chain(self) -> Chain:
        x = SPACING * torch.arange(1, OBSTACLES + 1, dtype=torch.float64)
        y = self._uniform(-self.half, self.half, OBSTACLES)
        y[:2] = self.first[0, [self.at["y1"], self.at["y2"]]]
        return Chain(x, y, torch.ones_like(x), torch.zeros_like(x))

    def _passed(self, x: torch.Tensor, obstacle: torch.Tensor) -> torch.Tensor:
        return x > obstacle


class TrackRiver(River):
    """The river of `ship_track.yaml`."""

    def reset(self) -> torch.Tensor:
        self.view, self.no_obs = (float(self.system.decl.constants[name][0]) for name in ("view", "no_obs"))
        return super().reset()

    def advance(self, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Advance as the base class; an obstacle that comes into view renews the allowance."""
        saw, now, tau = self._in_view(x, self.next), super().advance(x, action), self.at["tau"]
        comes = self._in_view(now, self.next) & (self.switched | ~saw)
        now[:, tau] = torch.where(comes, self.chain.allowance[self.next], now[:, tau])
        self.given |= comes
        self.late |= self.given & (now[:, tau] < -1e-6)
        return now

    def progress(self) -> Mapping[str, float]:
        """Metrics of the base class, and the number of ships that exceeded an allowance."""
        return {**super().progress(), "ships_late": float(self.late.sum())}

    def _calmed(self, states: torch.Tensor) -> torch.Tensor:
        calm = states.clone()
        calm[..., self.at["y"]] *= 0.5
        calm[..., self.at["psi"]] = 0.0
        calm[..., self.at["tau"]] = 15 * self.system.dt
        return calm

    def _begun(self, x: torch.Tensor) -> torch.Tensor:
        self.given = x[:, self.at["tau"]] >= 0.0
        self.late = torch.zeros_like(self.given)
        return super()._begun(x)

    def _chain(self) -> Chain:
        gaps = self._uniform(NEAREST, FARTHEST, OBSTACLES)
        gaps[0] = self.first[0, self.at["x1"]]
        r = self._uniform(0.6, 1.2, OBSTACLES)
        r[0] = self.first[0, self.at["r1"]]
        steps = torch.full_like(r, ALLOWANCES[-1][1])
        for below, allowed in reversed(ALLOWANCES):
            steps = torch.where(r < below, torch.full_like(r, allowed), steps)
        return Chain(gaps.cumsum(0), torch.zeros_like(r), r, self.system.dt * steps)

    def _passed(self, x: torch.Tensor, obstacle: torch.Tensor) -> torch.Tensor:
        return obstacle - x < -BEHIND

    def _facing(self, states: torch.Tensor, front: torch.Tensor | None = None) -> torch.Tensor:
        """As the base class, but an obstacle out of view is replaced by none, as in training."""
        front = self.next if front is None else front
        facing, x1 = super()._facing(states, front), self.at["x1"]
        none = states[:, self.at["x"]] + self.no_obs
        facing[:, x1] = torch.where(self._in_view(states, front), facing[:, x1], none)
        return facing

    def _in_view(self, states: torch.Tensor, front: torch.Tensor) -> torch.Tensor:
        """Mask of ships (k, n) with their next obstacle, index `front` (k,), in view."""
        return self.chain.x[front] - states[:, self.at["x"]] <= self.view


class ShiftedRiver(TrackRiver):
    """A river outside the training distribution of `ship_track.yaml` (an experiment of the paper)."""

    def _calmed(self, states: torch.Tensor) -> torch.Tensor:
        calm = states.clone()
        for ship, generator in zip(calm, self.streams.own, strict=True):
            off, side = torch.rand(2, len(ship), generator=generator, dtype=torch.float64)
            ship[:, self.at["y"]] = torch.where(side < 0.5, -1.0, 1.0) * (0.3 + 1.5 * off)
        for name, value in (("psi", 0.0), ("u", 5.0), ("v", 0.0), ("r", 0.0), ("tau", -5 * self.system.dt)):
            calm[..., self.at[name]] = value
        return calm

    def _chain(self) -> Chain:
        x = 4.0 + 12.0 * torch.arange(SHIFTED, dtype=torch.float64)
        y = torch.full_like(x, 0.2)
        y[0] = 0.25
        r = self._uniform(0.6, 1.2, SHIFTED)
        r[1] *= 1.5
        steps = torch.where(self._uniform(0.0, 1.0, SHIFTED) < 0.5, 20.0, 25.0)
        return Chain(x, y, r, self.system.dt * steps)

    def _allowed(self, states: torch.Tensor) -> torch.Tensor:
        """Mask of all starts: they are outside the system file's initial set."""
        return torch.ones(len(states), dtype=torch.bool)


def draw_row(axes: Any, row: int, obstacles: np.ndarray, half: float, pitch: float) -> None:
    """Draw one row of a river of width `2 * half`, with its obstacles (M, 3); rows are `pitch` apart."""
    from matplotlib.patches import Circle, Rectangle

    middle = -row * pitch
    axes.add_patch(Rectangle((0, middle - half - 0.3), FOLD, 2 * half + 0.6, color=BANK, lw=0))
    water = axes.add_patch(Rectangle((0, middle - half), FOLD, 2 * half, color=WATER, lw=0))
    axes.plot((0, FOLD), (middle, middle), color="white", lw=0.8, ls=(0, (6, 6)), zorder=1.5)
    for x, y, r in obstacles:
        if -r < x - row * FOLD < FOLD + r:
            stone = axes.add_patch(Circle((x - row * FOLD, middle + y), r, color=STONE, lw=0, zorder=2))
            stone.set_clip_path(water)
    axes.text(-1.1, middle, f"{row * FOLD:.0f} m", ha="right", va="center", size=7.5, color=NOTE)
