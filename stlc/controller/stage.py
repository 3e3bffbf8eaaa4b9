"""Robots in space: what a world says of its agents so that they can be seen as bodies, links and all."""

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
        centre: metres from the base of its robot, (frames, agents, 3).
        radius: metres.
        color: as `#rrggbb`.
    """

    centre: NDArray[np.float64]
    radius: float
    color: str


@dataclass(frozen=True, slots=True)
class Stage:
    """Robots of one kind, each with the balls around it.

    Attributes:
        urdf: the description of the robot.
        joints: angles of its movable joints in the order of the file, radians, (frames, agents, joints).
        balls: goals and obstacles.
        reach: metres from the base that are worth seeing.
        meshes: link -> file of those that come with PyBullet, for a description that has none.
    """

    urdf: Path
    joints: NDArray[np.float64]
    balls: tuple[Ball, ...]
    reach: float
    meshes: Mapping[str, str] = field(default_factory=dict)


@runtime_checkable
class Staged(Protocol):
    """World whose agents are robots with a description (URDF)."""

    @staticmethod
    def stage(scene: Scene) -> Stage:
        """The robots of snapshots stacked to (frames, …)."""
