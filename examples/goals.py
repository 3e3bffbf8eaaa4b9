"""The table of Meng & Fan (2023): an arm that reaches a sequence of goals around a post.

The true world for the model of `panda.yaml`. Each arm has its own sequence of goals and moves by the model's
step function. Metres, seconds.

* Starts and goals of arms are drawn as in training.
* A goal is reached when the flange is within 10 cm of it. One step later the next goal takes its place, so a
  recorded trace has the sample in which the goal was reached.
* An arm whose flange is inside the post stops for good.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from stlc.controller.sketch import (
    DECIDED,
    GOAL,
    NOTE,
    STONE,
    deciders,
    plans,
    scale_bar,
    tails,
    violations,
)
from stlc.controller.stage import Ball, Stage
from stlc.controller.streams import Streams

GOALS = 200
ORIGINS = np.array(  # from one joint to the next, then the flange
    [
        (0, 0, 0.333),
        (0, 0, 0),
        (0, -0.316, 0),
        (0.0825, 0, 0),
        (-0.0825, 0.384, 0),
        (0, 0, 0),
        (0.088, 0, 0),
        (0, 0, 0.107),
    ]
)
ROLLS = np.radians([0, -90, 90, 90, -90, 90, 90])  # about x, joint by joint
REACH, PITCH = 0.95, 2.0  # m shown around an arm in a picture, and distance between arms
ABOVE = -1.35  # m from the floor of the side views to the middle of the top views
TAIL = 10  # frames of a visible trail
MESHES = {  # meshes of the links, among those of PyBullet
    f"panda_link{link}": f"franka_panda/meshes/{'visual' if 0 < link < 7 else 'collision'}/link{link}.obj"
    for link in range(8)
}


def links(q: np.ndarray) -> np.ndarray:
    """Positions of joints and flange, from the base on: angles (arms, 7) -> (arms, 9, 3)."""
    turn, place = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    found = [place]
    for joint, (origin, roll) in enumerate(zip(ORIGINS, ROLLS, strict=False)):
        place = place + turn @ origin
        found.append(place)
        c, s = math.cos(roll), math.sin(roll)
        tilted = turn @ np.array([(1, 0, 0), (0, c, -s), (0, s, c)])
        cos, sin = np.cos(q[:, joint, None]), np.sin(q[:, joint, None])
        ahead, aside = tilted[..., 0], tilted[..., 1]
        turn = np.stack((cos * ahead + sin * aside, cos * aside - sin * ahead, tilted[..., 2]), -1)
    return np.stack([*found, place + turn @ ORIGINS[-1]], 1)


class Goals:
    """The world of `panda.yaml`, a `stlc.controller.world.World`; see the module's text."""

    def __init__(self, system: Any, agents: int, generator: torch.Generator) -> None:
        self.system, self.agents, self.generator = system, agents, generator
        at = {name: index for index, name in enumerate(system.names)}
        self.joints = [at[f"q[{joint}]"] for joint in range(7)]
        self.goal = [at[f"goal[{axis}]"] for axis in range(3)]
        constants = system.decl.constants
        self.post = np.array([constants[f"post[{axis}]"][0] for axis in range(3)], dtype=float)
        self.r_post, self.r_goal = (float(constants[name][0]) for name in ("r_o", "r_g"))

    def reset(self) -> torch.Tensor:
        """Draw the start of every arm and its first goal."""
        drawn = Streams.of(self.generator, self.agents).states(self.system, GOALS)
        self.goals, self.number = drawn[..., self.goal], torch.zeros(self.agents, dtype=torch.int64)
        self.struck, self.travelled = np.zeros(self.agents, dtype=bool), np.zeros(self.agents)
        self.state = drawn[:, 0].clone()
        self.struck |= self._inside(self._flange(self.state))
        return self.state

    def advance(self, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Advance every arm by one model step; (agents, n), (agents, m) -> (agents, n)."""
        before = self._flange(x)
        self.struck |= self._inside(before)
        still = torch.from_numpy(self.struck)
        moved = self.system.step(x, torch.where(still[:, None], torch.zeros_like(action), action))
        apart = np.linalg.norm(before - self.goals[torch.arange(self.agents), self.number].numpy(), axis=1)
        reached = torch.from_numpy((apart < self.r_goal) & ~self.struck)
        self.number = (self.number + reached).clamp(max=GOALS - 1)
        moved[:, self.goal] = self.goals[torch.arange(self.agents), self.number]
        after = self._flange(moved)
        self.travelled += np.linalg.norm(after - before, axis=1)
        self.struck |= self._inside(after)
        self.state = moved
        return moved

    def progress(self) -> Mapping[str, float]:
        """Mean goals reached and path length of the flange, and number of arms that have struck the post."""
        return {
            "goals_reached": float(self.number.double().mean()),
            "path": float(self.travelled.mean()),
            "arms_struck": float(self.struck.sum()),
        }

    def units(self) -> Mapping[str, str]:
        """Units of the entries of `progress`."""
        return {"path": "m"}

    def snapshot(self) -> Mapping[str, np.ndarray]:
        """Angles (agents, 7), arms from the base on (agents, 9, 3), goals (agents, 3), post, radii (5,)."""
        return {
            "joints": self.state[:, self.joints].numpy(),
            "arms": links(self.state[:, self.joints].numpy()),
            "goals": self.state[:, self.goal].numpy(),
            "post": np.array([*self.post, self.r_post, self.r_goal]),
        }

    def charted(self, states: torch.Tensor) -> np.ndarray:
        """Flange positions of planned states (agents, k, n), (agents, k, 3)."""
        agents, count = states.shape[:2]
        return self._flange(states.flatten(0, 1)).reshape(agents, count, 3)

    KEYS: ClassVar = {"goal": GOAL, "obstacle": STONE}

    @staticmethod
    def draw(axes: Any, scene: Mapping[str, np.ndarray], index: int) -> None:
        """One frame: arms side by side, from the side and from above, coloured by decision source."""
        from matplotlib.patches import Circle

        arms, goals, post = scene["arms"], scene["goals"][index], scene["post"][index]
        who = deciders(scene, index, arms.shape[1])
        bases = PITCH * np.arange(arms.shape[1])
        for floor, up in ((0.0, 2), (ABOVE, 1)):
            seen = arms[..., [0, up]] + np.stack((bases, np.full_like(bases, floor)), -1)[:, None]
            tails(axes, seen[:, :, -1], scene, index, frames=TAIL)
            origin = np.stack((bases, np.full_like(bases, floor)), -1)[:, None]
            sides = [0, up]
            plans(axes, scene, index, lambda places, s=sides, o=origin: places[..., s] + o)
            violations(axes, seen[index, :, -1], scene, index)
            for base, arm, goal, source in zip(bases, seen[index], goals, who, strict=True):
                color = DECIDED[source]
                axes.add_patch(
                    Circle((base + post[0], floor + post[up]), post[3], color=STONE, lw=0, alpha=0.55)
                )
                axes.plot(*arm.T, color=color, lw=2.2, alpha=0.85, zorder=3, solid_joinstyle="round")
                axes.plot(*arm[-1], "o", color=color, ms=4, mec="white", mew=0.6, zorder=4)
                place = (base + goal[0], floor + goal[up])
                axes.add_patch(Circle(place, post[4], fc="none", ec=GOAL, lw=1.2, zorder=2))
        for number, base in enumerate(bases):
            axes.plot((base - REACH, base + REACH), (0, 0), color=NOTE, lw=0.6, alpha=0.4, zorder=0)
            axes.text(base, ABOVE - REACH, f"arm {number}", ha="center", va="top", size=7.5, color=NOTE)
        for height, words in ((0.5 * REACH, "from the side"), (ABOVE, "from above")):
            axes.text(
                -REACH - 0.15, height, words, rotation=90, ha="center", va="center", size=7.5, color=NOTE
            )
        scale_bar(axes, bases[-1] + REACH - 0.5, ABOVE - REACH - 0.15, 0.5)
        axes.set(xlim=(-REACH - 0.3, bases[-1] + REACH), ylim=(ABOVE - REACH - 0.25, 1.25), aspect="equal")
        axes.set_axis_off()

    @staticmethod
    def stage(scene: Mapping[str, np.ndarray]) -> Stage:
        """The 3D stage of the arms, with the bodies of `panda.urdf`."""
        goals, post = scene["goals"], scene["post"]
        centre = np.broadcast_to(post[:, None, :3], goals.shape)
        balls = (Ball(goals, float(post[0, 4]), GOAL), Ball(centre, float(post[0, 3]), STONE))
        return Stage(Path(__file__).with_name("panda.urdf"), scene["joints"], balls, 0.95, MESHES)

    def _flange(self, states: torch.Tensor) -> np.ndarray:
        """Flange positions, (agents, 3)."""
        return links(states[:, self.joints].numpy())[:, -1]

    def _inside(self, flange: np.ndarray) -> np.ndarray:
        """Mask of flanges (agents, 3) inside the post."""
        return np.asarray(np.linalg.norm(flange - self.post, axis=1) < self.r_post)
