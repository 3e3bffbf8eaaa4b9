"""Search by a surrogate: a model of the robustness chooses which of many candidates is simulated.

A simulation tells more than whether its point is better than the best one. A Gaussian process (Rasmussen and
Williams 2006), fitted to all points so far, predicts the robustness of candidates with an uncertainty. The
candidate with the least lower confidence bound (Srinivas and others 2010) is simulated.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.strategies import (
    CoarseSampling,
    LocalSearch,
    UniformSampling,
    neighbour,
    vertex_sampling,
)

LENGTHS = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Length scales that are compared, times the root of the number of coordinates."""
NOISES = (1e-3, 1e-2, 1e-1, 1.0)
"""Variances of the noise that are compared, times that of the robustness. Chattering is noise."""
JITTER = 1e-6
"""Least variance of the noise, for the sake of the numerics."""
FITTED = 300
"""Points at most to which the process is fitted: the least robust ones."""
GROWN = 1.15
"""Growth of the number of points after which length scale and noise are chosen anew."""
CANDIDATES = 200
"""Candidates of a proposal: one half neighbours of the best points, the other half random ones."""
BOLDNESS = (0.0, 1.0, 1.0, 3.0)
"""Standard deviations below the mean at which candidates are compared; one of these is drawn each time."""
DIGITS = 6
"""Decimal digits of what is compared, so that rounding, which depends on the machine, decides nothing."""


class RobustnessProcess:
    """Gaussian process with a Matern kernel (smoothness 5/2) and a constant mean.

    Length scale and noise are those of a small grid that make the values most likely.
    """

    def __init__(self) -> None:
        self._length, self._noise, self._chosen_at = 1.0, 1.0, 0

    def fit(self, points: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        """Fit the process to values (count,) at points (count, dim)."""
        self._mean = float(values.mean())
        rest = values - self._mean
        distances = _distances(points, points)
        if len(points) > GROWN * self._chosen_at:
            self._chosen_at = len(points)
            root = math.sqrt(points.shape[1])
            grid = [(length * root, noise) for length in LENGTHS for noise in NOISES]
            fits = [_likelihood(distances, rest, length, noise) for length, noise in grid]
            self._length, self._noise = grid[int(np.argmax(np.round(fits, DIGITS)))]
        self._points = points
        covariance = _matern(distances, self._length) + (self._noise + JITTER) * np.eye(len(points))
        self._inverse = np.linalg.inv(covariance)
        self._weights = self._inverse @ rest
        self._variance = float(rest @ self._weights) / len(points)

    def predict(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Means and standard deviations, (count,) each, of values without noise at points (count, dim)."""
        covariance = _matern(_distances(points, self._points), self._length)
        means = self._mean + covariance @ self._weights
        left = 1.0 - (covariance @ self._inverse * covariance).sum(1)
        return means, np.sqrt(np.maximum(left, 0.0) * max(self._variance, 0.0))


def _distances(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances between points (n, dim) and (m, dim), as (n, m)."""
    squares = (left**2).sum(1)[:, None] + (right**2).sum(1)[None] - 2.0 * left @ right.T
    found: NDArray[np.float64] = np.sqrt(np.maximum(squares, 0.0))
    return found


def _matern(distances: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    scaled = math.sqrt(5.0) / length * distances
    found: NDArray[np.float64] = (1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled)
    return found


def _likelihood(
    distances: NDArray[np.float64], rest: NDArray[np.float64], length: float, noise: float
) -> float:
    """Logarithm of the likelihood of values `rest` without their mean, at the most likely variance."""
    count = len(rest)
    lower = np.linalg.cholesky(_matern(distances, length) + (noise + JITTER) * np.eye(count))
    whitened = np.linalg.solve(lower, rest)
    variance = float(whitened @ whitened) / count
    return -0.5 * count * math.log(variance + 1e-12) - float(np.log(np.diag(lower)).sum())


def _normal_scores(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (count,) replaced by the quantiles of the normal distribution at their ranks.

    Then a few very large values, of no interest, do not decide about the length scale. Equal values have the
    mean of their ranks.
    """
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - 0.5 * (counts + 1))[places]
    normal, count = NormalDist(), len(values)
    return np.array([normal.inv_cdf((rank + 0.5) / count) for rank in ranks.tolist()])


class SurrogateSearch(LocalSearch):
    """The candidate with the least lower confidence bound of a Gaussian process, fitted to all points so far.

    Candidates are neighbours of the best points, and random points. None of them is simulated twice.
    """

    name = "surrogate"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._process = RobustnessProcess()
        kinds = CoarseSampling, vertex_sampling, UniformSampling
        self._samplers = tuple(kind(space, generator) for kind in kinds)
        self._points: list[Point] = []
        self._values: list[float] = []
        self._known: set[bytes] = set()

    def propose(self) -> Point:
        if not self._kept:
            return self._samplers[0].propose()
        values = np.array(self._values)
        kept = np.argsort(values, kind="stable")[:FITTED]
        near = CANDIDATES // 2
        candidates = [neighbour(self.space, self.generator, self._one_of_the_best()) for _ in range(near)]
        candidates += [
            self._samplers[index % len(self._samplers)].propose() for index in range(CANDIDATES - near)
        ]
        new = [each for each in candidates if each.tobytes() not in self._known] or candidates
        self._process.fit(np.array(self._points)[kept], _normal_scores(values[kept]))
        means, deviations = self._process.predict(np.array(new))
        bounds = means - self.generator.choice(BOLDNESS) * deviations
        return new[int(np.argmin(np.round(bounds, DIGITS)))]

    def observe(self, point: Point, value: float) -> None:
        super().observe(point, value)
        self._points.append(point)
        self._values.append(value)
        self._known.add(point.tobytes())
