"""What worlds draw with: the colours of who decided, and the paths behind the agents.

Only NumPy is needed here; axes are those of matplotlib that `World.draw` is given.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Scene: TypeAlias = Mapping[str, NDArray[Any]]

DECIDED = ("#0072b2", "#e69f00", "#cc79a7", "#56b4e9")
"""Colours by `stlc.controller.deploy.SOURCES`; told apart by the colour-blind, too."""
DECIDERS = ("policy", "backup", "safest prefix", "polished plan")
"""The same in words."""
GROUND, WALL, STONE, GOAL, WATER, BANK, CHARGE = (
    *("#f1f3f5", "#9aa0aa", "#8a8f98", "#009e73", "#e8f0f7", "#c9d2bf", "#f0d58a"),
)
"""What stands around: floors, walls and obstacles in greys, what is to be reached in green."""
NOTE = "#4a4f57"
"""Of small writing."""
FADED = 0.75
"""How strong a path is behind an agent: weaker, the policy's would look like that of a polished plan."""


def deciders(scene: Scene, index: int, agents: int) -> NDArray[np.int64]:
    """Who decided at frame `index`, (agents,); the policy where nobody recorded it."""
    if "decision" not in scene:
        return np.zeros(agents, dtype=np.int64)
    return np.asarray(scene["decision"][index], dtype=np.int64)


def tails(axes: Any, paths: NDArray[np.float64], scene: Scene, index: int, *, frames: int) -> None:
    """Draw the last so many frames of every agent's path, each stretch in the colour of who decided it.

    Args:
        axes: to draw on.
        paths: where agents are in the picture, (frames, agents, 2); NaN breaks a path.
        scene: for its `decision`.
        index: the present frame.
        frames: how many are seen behind it.
    """
    first = max(0, index - frames)
    begin, end = paths[first:index], paths[first + 1 : index + 1]
    who = np.zeros(begin.shape[:2], dtype=np.int64)
    if "decision" in scene:
        who = scene["decision"][first:index].astype(np.int64)
    drawn = np.isfinite(begin + end).all(2)
    for source, color in enumerate(DECIDED):
        mine = drawn & (who == source)
        if mine.any():
            gap = np.full((int(mine.sum()), 2), np.nan)
            stretches = np.stack((begin[mine], end[mine], gap), 1).reshape(-1, 2)
            axes.plot(*stretches.T, color=color, lw=1.1, alpha=FADED, zorder=2.5, solid_capstyle="round")


def outlines(
    axes: Any, shape: NDArray[np.float64], poses: NDArray[np.float64], who: NDArray[np.int64]
) -> None:
    """Draw agents as polygons: `shape` (points, 2) ahead and aside, at poses (agents, 3) of x, y, heading."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turned = shape @ np.stack([np.stack([cos, sin], 1), np.stack([-sin, cos], 1)], 1)
    for place, points, source in zip(poses[:, None, :2], turned, who, strict=True):
        axes.fill(*(place + points).T, fc=DECIDED[source], ec="white", lw=0.4, zorder=3)


def pieces(
    axes: Any, places: NDArray[np.float64], piece: NDArray[np.float64], color: str, width: float
) -> None:
    """Draw the same short line `piece` (2, 2) at many places (k, 2), as one line with gaps."""
    lines = np.pad(places[:, None] + piece, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
    axes.plot(*lines.reshape(-1, 2).T, color=color, lw=width, zorder=2)
