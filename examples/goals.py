"""The table of Meng & Fan (2023): an arm that reaches for one goal after the other, around a post.

The truth beside the model of `panda.yaml`. Each arm has a list of goals of its own and moves as the model's
own step says. Metres, seconds.

* An arm starts at random, as in training; its goals are drawn as in training, too.
* A goal is reached when the flange is within 10 cm of it. One step later the next goal takes its place, so a
  recorded trace has the sample in which the goal was reached.
* An arm whose flange is inside of the post stands still from then on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

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
SIDE = 2.2  # m from the view from above to the one from the side
DECIDED = ("#2563a8", "#e08a00", "#c0267e", "#2e9e5b")  # policy, backup, safest, polished
POST, GOAL, FRAME = "#8a8f98", "#2f9e57", "#d5d8dd"


def links(q: np.ndarray) -> np.ndarray:
    """Where joints and flange are, from the base on: angles (arms, 7) -> (arms, 9, 3)."""
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
    """The world of `panda.yaml`; see the module's text. Implements `stlc.controller.world.World`."""

    def __init__(self, system: Any, agents: int, generator: torch.Generator) -> None:
        self.system, self.agents, self.generator = system, agents, generator
        at = {name: index for index, name in enumerate(system.names)}
        self.joints = [at[f"q[{joint}]"] for joint in range(7)]
        self.goal = [at[f"goal[{axis}]"] for axis in range(3)]
        constants = system.decl.constants
        self.post = np.array([constants[f"post[{axis}]"][0] for axis in range(3)], dtype=float)
        self.r_post, self.r_goal = (float(constants[name][0]) for name in ("r_o", "r_g"))

    def reset(self) -> torch.Tensor:
        """Every arm at a start of its own, with its first goal."""
        drawn = Streams.of(self.generator, self.agents).states(self.system, GOALS)
        self.goals, self.number = drawn[..., self.goal], torch.zeros(self.agents, dtype=torch.int64)
        self.struck, self.travelled = np.zeros(self.agents, dtype=bool), np.zeros(self.agents)
        self.state = drawn[:, 0].clone()
        self.struck |= self._inside(self._flange(self.state))
        return self.state

    def advance(self, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Move every arm as the model says for one step; (agents, n), (agents, m) -> (agents, n)."""
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
        """Mean goals reached and path of the flange, and how many arms have struck the post."""
        return {
            "goals_reached": float(self.number.double().mean()),
            "path": float(self.travelled.mean()),
            "arms_struck": float(self.struck.sum()),
        }

    def units(self) -> Mapping[str, str]:
        """Of entries of `progress`."""
        return {"path": "m"}

    def snapshot(self) -> Mapping[str, np.ndarray]:
        """Arms (agents, 9, 3) from base to flange, their goals (agents, 3), and post and radii (5,)."""
        return {
            "arms": links(self.state[:, self.joints].numpy()),
            "goals": self.state[:, self.goal].numpy(),
            "post": np.array([*self.post, self.r_post, self.r_goal]),
        }

    @staticmethod
    def draw(axes: Any, scene: Mapping[str, np.ndarray], index: int) -> None:
        """One frame: all arms from above, and from the side beside it, coloured by who decided."""
        from matplotlib.patches import Circle

        arms, goals, post = scene["arms"][index], scene["goals"][index], scene["post"][index]
        decided = scene["decision"][index] if "decision" in scene else np.zeros(len(arms), dtype=int)
        for left, (across, up) in ((0.0, (0, 1)), (SIDE, (0, 2))):
            axes.axhline(0.0, color=FRAME, lw=0.6, zorder=0)
            axes.add_patch(Circle((left + post[across], post[up]), post[3], color=POST, lw=0, alpha=0.6))
            for arm, goal, source in zip(arms, goals, decided, strict=True):
                color = DECIDED[int(source)]
                axes.plot(left + arm[:, across], arm[:, up], color=color, lw=2.0, alpha=0.8, zorder=3)
                axes.plot(left + arm[-1, across], arm[-1, up], "o", color=color, ms=4, zorder=4)
                place = (left + goal[across], goal[up])
                axes.add_patch(Circle(place, post[4], fill=False, color=GOAL, lw=1.2, zorder=2))
        axes.text(0.0, 1.25, "from above", ha="center", size=8, color="#4a4f57")
        axes.text(SIDE, 1.25, "from the side", ha="center", size=8, color="#4a4f57")
        axes.set(xlim=(-1.1, SIDE + 1.1), ylim=(-1.0, 1.4), aspect="equal")
        axes.set_axis_off()

    def _flange(self, states: torch.Tensor) -> np.ndarray:
        """Where flanges are, (agents, 3)."""
        return links(states[:, self.joints].numpy())[:, -1]

    def _inside(self, flange: np.ndarray) -> np.ndarray:
        """Whether flanges (agents, 3) are inside of the post."""
        return np.asarray(np.linalg.norm(flange - self.post, axis=1) < self.r_post)
