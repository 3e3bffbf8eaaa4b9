"""Search by a surrogate: a model of the robustness chooses which of many candidates is simulated.

A simulation tells more than whether its point is better than the best one. A Gaussian process (Rasmussen and
Williams 2006), fitted to all points so far or to those near a good one, predicts the robustness of candidates
with an uncertainty. The candidate with the least lower confidence bound (Srinivas and others 2010) is
simulated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
WEIGHTS = (0.0, 1.0, 2.0, 4.0)
"""Weights of the means of inputs that are compared."""
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
NEAREST = 60
"""Points at most to which the process of a trust region is fitted."""
FIRST_WIDTH, LEAST_WIDTH, MOST_WIDTH = 0.2, 0.02, 0.5
"""Standard deviations of the changes in a trust region: at first, and their bounds."""
WIDENED, NARROWED, FAILURES = 1.5, 0.7, 8
"""Factors of the width after progress, and after this number of proposals without any."""
DIGITS = 6
"""Decimal digits of what is compared, so that rounding, which depends on the machine, decides nothing."""


class RobustnessProcess:
    """Gaussian process with a Matern kernel (smoothness 5/2) and a constant mean.

    The distance of two points is that of their coordinates and, with a weight, of the means of their inputs
    over time: how much an input is high often matters more than when. Length scale, noise and this weight
    are those of a small grid that make the values most likely.
    """

    def __init__(self, space: SearchSpace | None = None) -> None:
        """Fit to points of a space whose inputs' means count; None: to coordinates alone."""
        blocks = () if space is None else space.blocks
        self._inputs = [list(block.values) for block in blocks if len(block.values) > 1]
        self._length, self._noise, self._weight, self._chosen_at = 1.0, 1.0, 0.0, 0

    def fit(self, points: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        """Fit the process to values (count,) at points (count, dim)."""
        self._mean = float(values.mean())
        rest = values - self._mean
        if len(points) > GROWN * self._chosen_at:
            self._chosen_at = len(points)
            root = math.sqrt(points.shape[1])
            grid, fits = [], []
            for weight in WEIGHTS if self._inputs else (0.0,):
                weighted = self._weighted(points, weight)
                distances = _distances(weighted, weighted)
                chosen = [(length * root, noise, weight) for length in LENGTHS for noise in NOISES]
                fits += [_likelihood(distances, rest, length, noise) for length, noise, _ in chosen]
                grid += chosen
            self._length, self._noise, self._weight = grid[int(np.argmax(np.round(fits, DIGITS)))]
        self._points = self._weighted(points, self._weight)
        distances = _distances(self._points, self._points)
        covariance = _matern(distances, self._length) + (self._noise + JITTER) * np.eye(len(points))
        self._inverse = np.linalg.inv(covariance)
        self._weights = self._inverse @ rest
        self._variance = float(rest @ self._weights) / len(points)

    def predict(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Means and standard deviations, (count,) each, of values without noise at points (count, dim)."""
        weighted = self._weighted(points, self._weight)
        covariance = _matern(_distances(weighted, self._points), self._length)
        means = self._mean + covariance @ self._weights
        left = 1.0 - (covariance @ self._inverse * covariance).sum(1)
        return means, np.sqrt(np.maximum(left, 0.0) * max(self._variance, 0.0))

    def _weighted(self, points: NDArray[np.float64], weight: float) -> NDArray[np.float64]:
        """Points (count, dim) with the weighted means of the inputs as further coordinates.

        With the weight 1, a mean adds to the squared distance as much as equal changes of all its values do.
        """
        if not weight:
            return points
        means = [weight * math.sqrt(len(each)) * points[:, each].mean(1) for each in self._inputs]
        return np.column_stack((points, *means))


def _distances(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances between points (n, dim) and (m, dim), as (n, m)."""
    squares = (left**2).sum(1)[:, None] + (right**2).sum(1)[None] - 2.0 * left @ right.T
    found: NDArray[np.float64] = np.sqrt(np.maximum(squares, 0.0))
    return found


def _matern(distances: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Correlations at distances."""
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
        self._process = RobustnessProcess(space)
        kinds = CoarseSampling, vertex_sampling, UniformSampling
        self._samplers = tuple(kind(space, generator) for kind in kinds)
        self._points: list[Point] = []
        self._values: list[float] = []
        self._known: set[bytes] = set()

    def propose(self) -> Point:
        if not self._kept:
            return self._samplers[0].propose()
        kept = np.argsort(np.array(self._values), kind="stable")[:FITTED]
        return self._least(self._process, kept, self._candidates(), BOLDNESS)

    def _least(
        self,
        process: RobustnessProcess,
        rows: NDArray[np.int64],
        candidates: Sequence[Point],
        boldness: Sequence[float],
    ) -> Point:
        """The candidate that a process, fitted to some of the points, expects to be the least robust.

        Args:
            process: the process, which is fitted.
            rows: indices of these points.
            candidates: the candidates; those that were simulated count only if there are no others.
            boldness: standard deviations below the mean, one of which is drawn.
        """
        new = [each for each in candidates if each.tobytes() not in self._known] or candidates
        process.fit(np.array(self._points)[rows], _normal_scores(np.array(self._values)[rows]))
        means, deviations = process.predict(np.array(new))
        bounds = means - self.generator.choice(boldness) * deviations
        return new[int(np.argmin(np.round(bounds, DIGITS)))]

    def _candidates(self) -> list[Point]:
        """Neighbours of the best points, and random ones."""
        near = CANDIDATES // 2
        found = [neighbour(self.space, self.generator, self._one_of_the_best()) for _ in range(near)]
        found += [self._samplers[index % len(self._samplers)].propose() for index in range(CANDIDATES - near)]
        return found

    def observe(self, point: Point, value: float) -> None:
        super().observe(point, value)
        self._points.append(point)
        self._values.append(value)
        self._known.add(point.tobytes())


class TrustRegionSearch(SurrogateSearch):
    """The same around one of the best points: a process of the points near it, and candidates close to it.

    A process of the whole space is too smooth where robustness changes fast. The candidates' distance grows
    with progress and shrinks without, as in the trust regions of Eriksson and others (2019).
    """

    name = "trust region"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._width, self._least_before, self._failures = FIRST_WIDTH, math.inf, 0

    def propose(self) -> Point:
        if not self._kept:
            return self._samplers[0].propose()
        self._adapt()
        centre = self._one_of_the_best()
        distances = _distances(centre[None], np.array(self._points))[0]
        near = np.argsort(np.round(distances, DIGITS), kind="stable")[:NEAREST]
        candidates = [self._moved(centre) for _ in range(CANDIDATES)]
        return self._least(RobustnessProcess(), near, candidates, (0.0, 1.0))

    def _adapt(self) -> None:
        """Widen the region if there was progress since the last proposal, and narrow it if there is none."""
        if self._kept[0].value < self._least_before:
            self._width, self._failures = min(WIDENED * self._width, MOST_WIDTH), 0
            self._least_before = self._kept[0].value
            return
        self._failures += 1
        if self._failures >= FAILURES:
            self._width, self._failures = max(NARROWED * self._width, LEAST_WIDTH), 0

    def _moved(self, centre: Point) -> Point:
        """Copy of a point with about two to half of its coordinates changed."""
        generator, dim = self.generator, self.space.dim
        changed = generator.random(dim) < max(2.0 / dim, 0.5 * generator.random())
        changed[generator.integers(dim)] = True
        steps = np.where(changed, self._width * generator.standard_normal(dim), 0.0)
        moved: Point = np.clip(centre + steps, 0.0, 1.0)
        return moved
