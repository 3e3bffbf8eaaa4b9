"""Search for failing drives of a policy, over all requirements at once and for a fixed number of simulations.

Unlike `falsify`, the search does not end at the first violation: it counts failures, and hands the states of
failing drives to the training.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.assurance.drive_simulator import DriveSimulator, JudgedDrives
from stlc.assurance.portfolio import Portfolio, Proposal
from stlc.assurance.search_space import Point, SearchSpace
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, SimulationStep, Watch
from stlc.controller.run.run import Run
from stlc.controller.training.failures import SearchRound
from stlc.native import Stop, never
from stlc.registry import GUARDS

DRIVE_SEARCH_VERSION = 2
"""Version of the search; results of older versions are recomputed."""
ROUND, ROWS = 16, 64
"""Simulations side by side at most in a round of a training, and their agents; two worlds in any case."""
PATIENCE = 100
"""Simulations without progress after which a requirement has only its turns."""
EARLIER = 3
"""Decisions before the first wrong one whose states are kept too."""
WRONG = 8
"""Wrong decisions of a failing drive whose states are kept, the earliest first; a quarter of other drives."""
Seen = Callable[[DeploymentRecording, JudgedDrives], None]
"""Function that receives the recorded drives of a batch, and the verdict on them."""


@dataclass(frozen=True, slots=True)
class SearchedDrives:
    """Simulations of a search, in the order in which they were made.

    Attributes:
        points: points of the unit cube, (count, dim).
        margins: robustness of each agent, (count, agents, requirements).
        values: least scaled robustness over agents and requirements, (count,).
    """

    points: NDArray[np.float64]
    margins: NDArray[np.float64]
    values: NDArray[np.float64]

    @property
    def failing(self) -> NDArray[np.bool_]:
        """True if each drive violates a requirement, (count, agents)."""
        return np.asarray(TOLERANCE.violated(self.margins).any(2))

    @property
    def least(self) -> float:
        """Least robustness of all drives and requirements."""
        return float(self.margins.min())

    def worst(self, count: int) -> NDArray[np.float64]:
        """Points of the simulations with the least values, (k, dim) with k at most `count`."""
        return self.points[np.argsort(self.values, kind="stable")[:count]]


def search_drives(
    simulator: DriveSimulator,
    count: int,
    *,
    seed: int,
    random: bool = False,
    starts: NDArray[np.float64] | None = None,
    seen: Seen = lambda _recording, _margins: None,
    over: Stop = never,
    watch: Watch | None = None,
) -> SearchedDrives:
    """Search for drives that violate any requirement, in at most `count` simulations.

    Apart from `starts`, the points of the first batch are uniform. Then every requirement has a search of its
    own, which sees all simulations: half of the points are proposed for the requirement that is closest to a
    violation, or violated most, while that makes progress, and the rest for all requirements in turn. For
    this comparison, the robustness of each requirement is divided by its median size in the first batch, so
    that a requirement in radians and one in metres count alike.

    Args:
        simulator: simulator of the policy in its world.
        count: number of simulations at most.
        seed: seed of the search; the same seed gives the same simulations.
        random: whether points are drawn from the declared distribution only, as a baseline.
        starts: points that are simulated first, (k, dim).
        seen: function that receives the recorded drives of each batch.
        over: function that is called after each batch; the search ends once it returns True.
        watch: function that is called at every step of the simulations.
    """
    space, generator = simulator.space, np.random.default_rng(seed)
    points, margins = list[Point](), list[NDArray[np.float64]]()
    searches: _Searches | None = None
    first = [] if starts is None else [each for each in starts if each.shape == (space.dim,)][:count]
    while len(points) < count and not (points and over()):
        size = min(simulator.batch, count - len(points))
        asked = [_Asked(each) for each in first[len(points) : len(points) + size]]
        while len(asked) < size:
            if random or searches is None:
                asked.append(_Asked(generator.random(space.dim)))
            else:
                asked.append(searches.ask())
        batch = [each.point for each in asked]
        recording = simulator.drive(np.stack(batch), watch)
        judged = simulator.judge(recording)
        found = judged.margins
        seen(recording, judged)
        points += batch
        margins += list(found)
        if searches is None:
            searches = _Searches(space, generator, scale_of(found))
        for each, own in zip(asked, found.min(1), strict=True):
            searches.tell(each, own)
    every = np.stack(margins)
    return SearchedDrives(np.stack(points), every, (every / scale_of(every[: simulator.batch])).min((1, 2)))


@dataclass(frozen=True, slots=True)
class _Asked:
    """Point to simulate, and the search that proposed it: None for a uniform or given point."""

    point: Point
    search: int | None = None
    proposal: Proposal | None = None


class _Searches:
    """One search per requirement; they take turns and see all simulations."""

    def __init__(
        self, space: SearchSpace, generator: np.random.Generator, scale: NDArray[np.float64]
    ) -> None:
        """`scale`: sizes by which robustness is divided for comparison, (requirements,)."""
        self._scale = scale
        self._each = [Portfolio(space, generator, lambda _point: None) for _ in scale]
        self._least = np.full(len(scale), np.inf)
        self._idle = np.zeros(len(scale), dtype=int)  # own simulations since the last progress
        self._turn = 0

    def ask(self) -> _Asked:
        """Return the next point: of the requirement that is violated most, or of all in turn."""
        live = [index for index, each in enumerate(self._each) if not each.flat] or [*range(len(self._each))]
        lively = [index for index in live if self._idle[index] < PATIENCE]
        self._turn += 1
        if self._turn % 2 and lively:
            search = min(lively, key=lambda index: self._least[index])
        else:
            search = live[self._turn // 2 % len(live)]
        proposal = self._each[search].next()
        return _Asked(proposal.point, search, proposal)

    def tell(self, asked: _Asked, margins: NDArray[np.float64]) -> None:
        """Report the robustness of each requirement at a point, (requirements,)."""
        values = margins / self._scale
        if asked.search is not None:
            self._idle[asked.search] += 1
        self._idle[values < self._least] = 0
        self._least = np.minimum(self._least, values)
        for index, (portfolio, value) in enumerate(zip(self._each, values.tolist(), strict=True)):
            if index == asked.search and asked.proposal is not None:
                portfolio.tell(asked.proposal, value)
            else:
                portfolio.observe(asked.point, value)


def scale_of(margins: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median size of the robustness of each requirement, (requirements,); 1 where it is 0 or infinite.

    `margins`: (count, agents, requirements).
    """
    size = np.median(np.abs(margins), (0, 1))
    return np.where(np.isfinite(size) & (size > 0.0), size, 1.0)


# ------------------------------------------------------------------ rounds of a training


class _StoppedError(Exception):
    """Raised when a training ends during a round."""


def round_of(
    run: Run, simulations: int, seed: int, starts: NDArray[np.float64], over: Stop, stop: Stop
) -> SearchRound | None:
    """Search for failing drives of a policy in training, and collect the states where it planned wrongly.

    Implements `stlc.controller.training.failures.FailureSearch`. The drives have no guard.

    Args:
        run: run with the present policy.
        simulations: number of simulations at most.
        seed: seed of the search.
        starts: points that are simulated first, (p, dim); half of the first batch at most.
        over: function that is called after each batch; no other batch follows once it returns True.
        stop: function that is called at every step; the search ends once it returns True.

    Returns:
        The states, and all points, the least robust first; None if `stop` ended the search.
    """
    test = run.task.system.decl.test
    setting = Setting((0,), test.agents, test.steps, test.replan)
    batch = min(max(ROWS // test.agents, 2), ROUND)
    simulator = DriveSimulator(run, GUARDS.default, setting, batch=batch)
    kept, ended = list[NDArray[np.float64]](), list[int]()

    def seen(recording: DeploymentRecording, judged: JudgedDrives) -> None:
        failing = TOLERANCE.violated(judged.margins).any(2).reshape(-1)
        kept.append(wrong_states(recording, failing, test.replan))
        ended.append(int(judged.inconclusive.sum()))

    def watch(_step: SimulationStep) -> None:
        if stop():
            raise _StoppedError

    try:
        first = starts[: min(batch, simulations) // 2]
        found = search_drives(
            simulator, simulations, seed=seed, starts=first, seen=seen, over=over, watch=watch
        )
    except _StoppedError:
        return None
    states = torch.from_numpy(np.concatenate(kept))
    states = states[run.task.alive(states)]  # from others, no plan satisfies the specification
    failing = found.failing
    judged = failing.size - sum(ended)
    return SearchRound(states, found.worst(len(found.points)), judged, int(failing.sum()))


def wrong_states(
    recording: DeploymentRecording, failing: NDArray[np.bool_], replan: int
) -> NDArray[np.float64]:
    """States at which the policy's own plan violates the specification, and some before the first of them.

    Args:
        recording: recorded drives.
        failing: drives that violate a requirement, (rows,); they contribute more states than others.
        replan: replanning period in steps; states between decisions are left out.

    Returns:
        States, (k, n).
    """
    decided = np.arange(recording.steps) % replan == 0
    wrong = ~TOLERANCE.satisfied(recording.policy_rho) & decided
    order = wrong.cumsum(1)
    chosen = wrong & (order <= np.where(failing, WRONG, WRONG // 4)[:, None])
    for row in np.flatnonzero(failing & wrong.any(1)):
        first = int(wrong[row].argmax())
        chosen[row, max(first - EARLIER * replan, 0) : first : replan] = True
    states = recording.states[:, :-1][chosen]
    finite: NDArray[np.float64] = states[np.isfinite(states).all(1)]
    return finite
