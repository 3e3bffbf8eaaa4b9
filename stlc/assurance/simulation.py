"""Simulations as a function of points of the unit cube: what a search sees of a system, and who simulates.

A search asks a `Simulator` for the robustness of one requirement at several points.
`stlc.assurance.sharing.SharedSimulator` shares these points out among worker processes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace

PARTS = 4
"""Number of parts into which the points are cut that a simulator prefers to simulate side by side."""


@dataclass(frozen=True, slots=True)
class Simulations:
    """Outcomes of simulations for one requirement.

    Attributes:
        margins: exact robustness, (count,); -inf where states are not finite.
        admissible: whether the initial state meets the conditions of `where`, (count,).
        judged: whether the requirement has a verdict, (count,); not if a simulation ended before it, or
            failed.
    """

    margins: NDArray[np.float64]
    admissible: NDArray[np.bool_]
    judged: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[Simulations]) -> Simulations:
        """The outcomes of all parts, one after the other."""
        return cls(
            np.concatenate([part.margins for part in parts]),
            np.concatenate([part.admissible for part in parts]),
            np.concatenate([part.judged for part in parts]),
        )


class Simulator(Protocol):
    """Simulations of a closed system, as a function of points in the unit cube.

    The outcome of a point depends on nothing but the point and the requirement, given by its index. The
    defaults are those of a black box of real signals without inputs, at the time step that it has.
    """

    @property
    def space(self) -> SearchSpace:
        """The search space."""

    @property
    def batch(self) -> int:
        """Number of points that are best simulated side by side."""

    @property
    def part(self) -> int:
        """Number of points that are simulated at once where simulations are shared out."""

    @property
    def requirements(self) -> Sequence[str]:
        """Names of the requirements."""

    def seen(self, requirement: int) -> float:  # noqa: ARG002
        """Share of the inputs' duration, at most 1, after which inputs no longer affect a requirement."""
        return 1.0

    def graded(self, requirement: int) -> bool:  # noqa: ARG002
        """True if the robustness varies with real signals, rather than with whole numbers."""
        return True

    def simulate(self, points: NDArray[np.float64], requirement: int) -> Simulations:
        """Simulate `points`, (count, dim), and judge them by a requirement."""

    def at_half_step(self, points: NDArray[np.float64], requirement: int) -> Simulations | None:  # noqa: ARG002
        """Outcomes at half the time step; None if the step cannot be changed."""
        return None

    def gradient(self, point: Point, requirement: int) -> Point | None:  # noqa: ARG002
        """Gradient of the exact robustness at a point, (dim,); None if there is none."""
        return None


class SimulatorSource(Protocol):
    """Description of a simulator that can be sent to another process."""

    def load(self) -> Simulator:
        """Load the simulator."""
