"""Functions with which worlds draw pictures: past paths, plans, violations, colours by a plan's source.

They need only NumPy; `axes` are the matplotlib axes that `World.draw` receives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Scene: TypeAlias = Mapping[str, NDArray[Any]]

DECIDED = ("#0072b2", "#e69f00", "#cc79a7", "#56b4e9")
"""Colours by the source of a plan (`SOURCES`); distinguishable for colour-blind readers."""
DECIDERS = ("policy", "backup", "safest prefix", "polished plan")
"""Labels of the colours."""
VIOLATED = "#c4161c"
"""Colour of violations and of rejected plans; far darker than the backup's orange."""
GROUND, WALL, STONE, GOAL, WATER, BANK, CHARGE = (
    *("#f1f3f5", "#9aa0aa", "#8a8f98", "#009e73", "#e8f0f7", "#c9d2bf", "#f0d58a"),
)
"""Colours of surroundings: floors, walls and obstacles in greys, goals in green."""
ROAD, STOP_LIGHT = "#e3e5e8", "#e5383b"
NOTE = "#4a4f57"
"""Colour of small text."""
SURROUNDINGS_ON_DARK = {
    GROUND: "#1d2229",
    WALL: "#5a616d",
    STONE: "#7b828e",
    WATER: "#15232f",
    BANK: "#3a4334",
    CHARGE: "#6e5a1e",
    NOTE: "#b4bbc6",
    ROAD: "#2b3038",
    STOP_LIGHT: "#ff6b66",
}
"""Colours of surroundings and small text -> those that replace them on a dark background."""
FADED = 0.75
"""Opacity of an agent's past path; a weaker one would make the policy's colour look like plan repair's."""


def deciders(scene: Scene, index: int, agents: int) -> NDArray[np.int64]:
    """Source of the plan that each agent follows at frame `index`, (agents,): an index into `SOURCES`.

    It is 0, the policy, if `scene` does not contain `decision`.
    """
    if "decision" not in scene:
        return np.zeros(agents, dtype=np.int64)
    return np.asarray(scene["decision"][index], dtype=np.int64)


def tails(axes: Any, paths: NDArray[np.float64], scene: Scene, index: int, *, frames: int) -> None:
    """Draw the last `frames` frames of every agent's path, coloured by the source of the followed plan.

    Args:
        axes: matplotlib axes.
        paths: picture coordinates of agents, (frames, agents, 2); NaN breaks a path.
        scene: recorded snapshots; their entry `decision` gives the source of each followed plan.
        index: the present frame.
        frames: number of past frames.
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


Placed: TypeAlias = "Callable[[NDArray[np.float64]], NDArray[np.float64]]"


def plans(axes: Any, scene: Scene, index: int, placed: Placed | None = None) -> None:
    """Draw the guard's interventions at frame `index`: the rejected plan dashed, its replacement solid.

    Args:
        axes: matplotlib axes.
        scene: recorded snapshots; `rejected` and `taken`, (frames, agents, k, 2 or 3), are read if present.
        index: the present frame.
        placed: function from world coordinates (agents, k, 2 or 3) to picture coordinates (agents, k, 2); NaN
            breaks a line.
    """
    if "rejected" not in scene:
        return
    who = deciders(scene, index, scene["rejected"].shape[1])
    for name, style, width in (("taken", "-", 1.6), ("rejected", (0, (3, 2)), 1.2)):
        places = np.asarray(scene[name][index], dtype=np.float64)
        lines = places if placed is None else placed(places)
        for line, source in zip(lines, who, strict=True):
            if np.isfinite(line).any():
                color = VIOLATED if name == "rejected" else DECIDED[source]
                axes.plot(*line.T, color=color, lw=width, ls=style, zorder=2.8)


def violations(axes: Any, places: NDArray[np.float64], scene: Scene, index: int) -> None:
    """Draw a ring and the number of each agent that violates a requirement, at `places`, (agents, 2).

    `scene["violated"]`, (frames, agents), marks these agents; without it nothing is drawn. `index`: the
    present frame.
    """
    if "violated" not in scene:
        return
    for agent in np.flatnonzero(scene["violated"][index]):
        if np.isfinite(places[agent]).all():
            axes.plot(*places[agent], "o", ms=17, mfc="none", mec=VIOLATED, mew=2.2, zorder=6)
            words = {"color": VIOLATED, "weight": "bold", "size": 8, "zorder": 6}
            axes.annotate(str(agent), places[agent], (9, 7), textcoords="offset points", **words)


def scale_bar(axes: Any, left: float, height: float, length: float, unit: str = "m") -> None:
    """Draw a scale bar of the given length from (left, height), in picture units, with its label above."""
    ends = (left, left, left, left + length, left + length, left + length)
    axes.plot(ends, height + 0.09 * length * np.array([-1, 1, 0, 0, 1, -1]), color=NOTE, lw=1.2, zorder=5)
    words = {"ha": "center", "va": "bottom", "size": 7.5, "color": NOTE}
    middle = (left + length / 2, height)
    axes.annotate(f"{length:g} {unit}", middle, (0, 3), textcoords="offset points", **words)


NUMBERED = 8
"""Maximum number of agents that are labelled with their number."""


def numbers(axes: Any, places: NDArray[np.float64]) -> None:
    """Label agents at `places`, (agents, 2), with their numbers if there are at most `NUMBERED` of them."""
    if len(places) <= NUMBERED:
        for agent, (x, y) in enumerate(places):
            words = {"ha": "center", "va": "center", "size": 6.5, "weight": "bold", "color": "white"}
            axes.text(x, y, str(agent), zorder=3.5, clip_on=True, **words)


def outlines(
    axes: Any,
    shape: NDArray[np.float64],
    poses: NDArray[np.float64],
    who: NDArray[np.int64],
    *,
    color: str | None = None,
) -> None:
    """Draw agents as polygons, with a dot at the place in the state where no number marks it.

    Args:
        axes: matplotlib axes.
        shape: corners of the polygon relative to an agent, (points, 2): forward, left.
        poses: x, y and heading (rad) of each agent, (agents, 3).
        who: source of each agent's plan, (agents,), which determines the colour.
        color: colour of all agents instead.
    """
    from matplotlib.collections import PolyCollection

    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turned = shape @ np.stack([np.stack([cos, sin], 1), np.stack([-sin, cos], 1)], 1)
    colors = color or [DECIDED[source] for source in who]
    placed = poses[:, None, :2] + turned
    axes.add_collection(PolyCollection(placed, fc=colors, ec="white", lw=0.6, alpha=0.92, zorder=3))
    if len(poses) > NUMBERED:
        axes.plot(*poses[:, :2].T, "o", ms=1.6, mew=0, color="white", zorder=3.5)


def segments(axes: Any, lines: NDArray[np.float64], color: str, width: float) -> None:
    """Draw k separate line segments, (k, 2 end points, 2)."""
    gaps = np.pad(lines, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
    axes.plot(*gaps.reshape(-1, 2).T, color=color, lw=width, zorder=2)


def pieces(
    axes: Any, places: NDArray[np.float64], piece: NDArray[np.float64], color: str, width: float
) -> None:
    """Draw a copy of the line segment `piece`, (2 end points, 2), at each of `places`, (k, 2).

    Only worlds in older run folders use this function.
    """
    segments(axes, places[:, None] + piece, color, width)
