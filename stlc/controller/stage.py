"""Three-dimensional scenes for PyBullet: robots with their links, and balls for goals and obstacles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Scene: TypeAlias = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Ball:
    """A sphere in space.

    Attributes:
        centre: position in metres from the base of the agent's robot, (frames, agents, 3).
        radius: metres.
        color: as `#rrggbb`.
    """

    centre: NDArray[np.float64]
    radius: float
    color: str


@dataclass(frozen=True, slots=True)
class Stage:
    """Robots of one kind for a three-dimensional picture, each with the balls around it.

    Attributes:
        urdf: robot description.
        joints: angles of the movable joints in file order, in radians, (frames, agents, joints).
        balls: goals and obstacles.
        reach: radius of the visible space around the base, in metres.
        meshes: link -> mesh file of PyBullet, for a description that contains no meshes.
    """

    urdf: Path
    joints: NDArray[np.float64]
    balls: tuple[Ball, ...]
    reach: float
    meshes: Mapping[str, str] = field(default_factory=dict)


@runtime_checkable
class Staged(Protocol):
    """World whose agents are robots with a description (URDF), which can be shown in three dimensions."""

    @staticmethod
    def stage(scene: Scene) -> Stage:
        """The robots to show, from snapshots that are stacked over time, (frames, …)."""
