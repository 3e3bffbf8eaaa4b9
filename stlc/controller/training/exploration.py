"""Search for plans by exploration: plans are built step by step from prefixes (their first actions).

Local search changes whole plans. If many goals must be reached in order, hardly any change reaches a further
goal without losing another. Therefore plans are built from prefixes here. For every prefix, bounds over all
continuations show which parts of the specification are violated by every continuation, which are satisfied by
every continuation, and which are open. Prefixes with a violated part are dropped. The others form layers, one
per length. Two prefixes of a layer are in the same cell if they satisfy the same parts and end in the same
region of the state space. A layer keeps only the best prefix of each cell. Prefixes that satisfy many parts,
and prefixes in rarely visited cells, are extended more often than others (Ecoffet et al. 2021, "First return,
then explore").
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.normal_form import pieces
from stlc.compile.ir.support import columns
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.native import Effort
from stlc.controller.training.local_search import TAILS, SearchResult, remainders

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from stlc.compile.schedule.schedule import Boundary
    from stlc.controller.problem.task import Task

Numbers = NDArray[np.float64]

CHILDREN = 512
"""Number of prefixes extended per batch."""
KEPT = 512
"""Maximum number of prefixes per layer."""
FINE, COARSE = 24, 5
"""Number of cells along each state that the specification reads, and along each other moving state."""
COUNTED = 6
"""Number of cells into which the range of a timer is divided."""
GROWTH = 0.1
"""Mean share of the horizon by which a prefix is extended at once."""
NEAR = 8.0
"""Logarithm of the factor by which a prefix of greatest worth is preferred to one of least worth."""
EFFORTS = (8, 24, 72)
"""Sweeps for a plan of `USUAL` steps: first attempt, and increased effort after failures."""
USUAL = 30
"""Plan length in steps to which `EFFORTS` refers; the cost of a sweep grows with its square."""
RAISED = 250
"""Generations of the local search that increases the margin of a found plan."""


@dataclass(frozen=True, slots=True)
class Layer:
    """Prefixes of plans of equal length, one per row; a piece is a conjunct of the specification.

    Attributes:
        states: predicted trajectories, (rows, steps + 1, n).
        plans: controls, (rows, steps, m).
        met: True where a piece is satisfied by every continuation of a prefix, (rows, pieces).
        kind: integers that describe each prefix, (rows, entries): its satisfied pieces, and the rounded
            values of its timers. Prefixes with equal rows are of the same kind.
        worth: sum of the lower bounds on the robustness of undecided pieces, (rows,).
        visits: number of times that each prefix was extended, (rows,).
    """

    states: Numbers
    plans: Numbers
    met: NDArray[np.bool_]
    kind: NDArray[np.int64]
    worth: Numbers
    visits: Numbers

    def __len__(self) -> int:
        return len(self.worth)

    def rows(self, index: NDArray[np.int64]) -> Layer:
        """Layer of the prefixes with the indices `index`, (k,)."""
        return Layer(*(getattr(self, name)[index] for name in Layer.__slots__))

    def joined(self, other: Layer) -> Layer:
        """Layer of the prefixes of this layer, followed by those of `other`."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in Layer.__slots__)
        return Layer(*map(np.concatenate, pairs))


@dataclass(frozen=True, slots=True)
class ExplorationResult:
    """Result of the exploration from one initial state.

    Attributes:
        plan: satisfying plan, (T, m) float64; None if none was found.
        sweeps: number of sweeps made; a sweep extends every layer once.
    """

    plan: Tensor | None
    sweeps: int


class Exploration:
    """Exploration of the plans of one task, from one initial state at a time.

    Attributes:
        task: specification and system.
        pieces: conjuncts of the specification.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.pieces = tuple(dict.fromkeys(part for rule in task.rules for part in pieces(rule.formula)))
        system = task.system
        self._low, self._high = (
            bound.double().numpy(force=True) for bound in (system.control_low, system.control_high)
        )
        self._turns = np.array([control.squash == "angle" for control in system.decl.controls])
        read = frozenset[str]().union(*(columns(piece) for piece in self.pieces))
        kinds = {timer.name: timer.kind for timer in system.timers}
        moving = system.exact_step.next.keys()
        free = [name for name in task.system.names if name in moving and name not in kinds]
        self._fine = [task.system.names.index(name) for name in free if name in read]
        self._coarse = [task.system.names.index(name) for name in free if name not in read]
        counts = [timer for timer in system.timers if timer.kind in ("timer", "latch")]
        self._counts = [task.system.names.index(timer.name) for timer in counts]
        self._cells = np.array([max((timer.high - timer.low) / COUNTED, 1.0) for timer in counts])

    def plan(
        self,
        x: Tensor,
        sweeps: int,
        generator: torch.Generator,
        enough: Callable[[], bool] = lambda: False,
    ) -> ExplorationResult:
        """Search for a satisfying plan from the state `x`.

        Args:
            x: the initial state, (n,).
            sweeps: maximum number of sweeps; a sweep extends every layer (the prefixes of one length) once.
            generator: source of the random numbers of the exploration.
            enough: function that is called before each sweep after the first; the exploration ends once it
                returns True.
        """
        random = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        start = x.double().numpy(force=True)[None, None]
        layers = [self._layer(start, np.empty((1, 0, len(self._low))))]
        layers += [layers[0].rows(np.empty(0, dtype=np.int64))] * self.task.horizon
        for sweep in range(sweeps):
            if sweep and enough():
                return ExplorationResult(None, sweep)
            for layer in range(self.task.horizon):
                if not len(layers[layer]):
                    continue
                grown = self._grown(layers[layer], random)
                length = grown.plans.shape[1]
                if length == self.task.horizon and len(grown):
                    return ExplorationResult(self._best(x, grown), sweep + 1)
                before = layers[length]
                layers[length] = self._thinned(before.joined(grown) if len(before) else grown, random)
        return ExplorationResult(None, sweeps)

    def solved(
        self,
        starts: Tensor,
        sweeps: int,
        generator: torch.Generator,
        spare: float,
        enough: Callable[[], bool] = lambda: False,
    ) -> SearchResult:
        """Find satisfying plans from some of the initial states, and from states that these plans visit.

        The states are tried in order while sweeps remain. If the specification adds timers to the state, some
        states that a plan visits serve as further initial states, since the remainder of the plan may satisfy
        the specification from there.

        Args:
            starts: initial states, (k, n).
            sweeps: total number of sweeps for plans of `USUAL` steps; fewer for longer plans.
            generator: source of the random numbers of the exploration.
            spare: a local search improves each plan found until its robustness is `spare`.
            enough: function that is called repeatedly; the exploration ends once it returns True.

        Returns:
            The plans found, with their initial states; empty if there are none.
        """
        sweeps = max(math.ceil(sweeps * min(1.0, (USUAL / self.task.horizon) ** 2)), 2)
        found = [
            SearchResult(starts[:0], starts.new_zeros(0, self.task.horizon, len(self._low)), starts[:0, 0])
        ]
        for x in starts:
            if sweeps <= 0 or (len(found) > 1 and enough()):
                break
            tried = self.plan(x, max(sweeps // 2, 2), generator, enough)
            sweeps -= tried.sweeps
            if tried.plan is not None:
                plan = self._raised(x, tried.plan.to(x.dtype), spare)[None]
                first = SearchResult(x[None], plan, self.task.judge(x[None], plan, states=False).rho)
                found.append(remainders(self.task, first, TAILS if self.task.compiled.timers else 1))
        return SearchResult(
            *(torch.cat([getattr(part, name) for part in found]) for name in SearchResult.__slots__)
        )

    # ------------------------------------------------------------------ found plans

    def _raised(self, x: Tensor, plan: Tensor, spare: float) -> Tensor:
        """Improve a plan (T, m) by local search until its robustness is `spare`.

        Without a native kernel (compiled code) the plan is returned unchanged.
        """
        if self.task.native is None:
            return plan
        effort = Effort(RAISED, spare, 0)
        return self.task.native.climb(x[None], plan[None], plan[None], effort)[0][0]

    def _best(self, x: Tensor, layer: Layer) -> Tensor:
        plans = torch.from_numpy(layer.plans)
        rho = self.task.judge(x.double().cpu().expand(len(plans), -1), plans, states=False).rho
        return plans[int(rho.argmax())]

    # ------------------------------------------------------------------ prefixes

    def _grown(self, layer: Layer, random: np.random.Generator) -> Layer:
        """Extend some prefixes (first actions of plans) of a layer, all by the same random number of steps.

        Returns:
            Layer of the longer prefixes that may still satisfy the specification.
        """
        chosen = self._chosen(layer, random)
        np.add.at(layer.visits, chosen, 1.0)
        horizon, before = self.task.horizon, layer.plans[chosen]
        more = min(horizon - before.shape[1], 1 + int(random.exponential(GROWTH * horizon)))
        piece, states = self._drawn(before, more, random), layer.states[chosen]
        with torch.no_grad():
            after = self.task.rollout(torch.from_numpy(states[:, -1]), torch.from_numpy(piece)).numpy()
        return self._layer(np.concatenate((states, after[:, 1:]), 1), np.concatenate((before, piece), 1))

    def _layer(self, states: Numbers, plans: Numbers) -> Layer:
        """Make a layer from those of the given prefixes that may still satisfy the specification.

        A prefix is a sequence of the first actions of a plan.

        Args:
            states: trajectories under the prefixes, (rows, steps + 1, n).
            plans: controls of the prefixes, (rows, steps, m).
        """
        good = np.isfinite(states).all((1, 2))
        states, plans = states[good], plans[good]
        whole = states.shape[1] == self.task.horizon + 1
        upper = self._bounds(states, "strict" if whole else "upper")
        alive = (upper >= -TOLERANCE).all(1)
        states, plans = states[alive], plans[alive]
        lower = upper[alive] if whole else self._bounds(states, "lower")
        met = lower >= -TOLERANCE
        worth = np.where(met | ~np.isfinite(lower), 0.0, lower).sum(1)
        counts = np.ceil(states[:, -1, self._counts] / self._cells)
        kind = np.concatenate((met, counts), 1).astype(np.int64)
        return Layer(states, plans, met, kind, worth, np.zeros(len(worth)))

    def _bounds(self, states: Numbers, end: Boundary) -> Numbers:
        """Bounds on the robustness of each piece over all continuations of each trajectory, (rows, pieces).

        A piece is a conjunct of the specification.

        Args:
            states: trajectories, (rows, samples, n).
            end: `lower` or `upper` for these bounds; `strict` for the exact robustness of whole trajectories.
        """
        if not len(states):
            return np.empty((0, len(self.pieces)))
        env = dict(zip(self.task.system.names, np.moveaxis(states, (0, 1, 2), (2, 1, 0)), strict=True))
        stop = None if end == "strict" else self.task.horizon + 1
        found = evaluate(self.pieces, env, ops=NUMPY, end=end, stop=stop)
        return np.stack([np.broadcast_to(each[0], len(states)) for each in found], 1)

    def _chosen(self, layer: Layer, random: np.random.Generator) -> NDArray[np.int64]:
        """Draw indices of prefixes to extend, (CHILDREN,).

        Prefixes with many satisfied pieces (conjuncts of the specification), high worth or few visits are
        preferred; see `Layer`.
        """
        kind = _numbered(layer.kind)
        rank = np.empty(len(layer))
        for each in range(kind.max() + 1):
            rows = np.flatnonzero(kind == each)
            rank[rows[np.argsort(-layer.worth[rows], kind="stable")]] = np.arange(len(rows)) / len(rows)
        share = (1.0 + layer.met.sum(1)) ** 2 / np.bincount(kind)[kind]
        rare, near = share / (1.0 + layer.visits), share * np.exp(-NEAR * rank)
        weight = rare / rare.sum() + near / near.sum()
        chosen: NDArray[np.int64] = random.choice(len(layer), CHILDREN, p=weight / weight.sum())
        return chosen

    def _drawn(self, plans: Numbers, more: int, random: np.random.Generator) -> Numbers:
        """Draw the controls of the next `more` steps after prefixes, (rows, more, m).

        Each row is of one of four kinds: constant random levels; constant controls at the low end, middle or
        high end of their ranges; the last controls of the prefix plus a random constant; independent random
        values.
        """
        rows, steps, controls = plans.shape
        span, shape = self._high - self._low, (rows, 1, controls)
        level = self._low + span * random.random(shape)
        ends = self._low + span * 0.5 * random.integers(0, 3, shape)
        last = (plans[:, -1:] if steps else level) + span * 0.2 * random.standard_normal(shape)
        free = self._low + span * random.random((rows, more, controls))
        kind = random.integers(0, 4, (rows, 1, 1))
        piece = np.choose(np.broadcast_to(kind, free.shape), (level, ends, last, free))
        turned = self._low + np.remainder(piece - self._low, span)
        drawn: Numbers = np.where(self._turns, turned, np.clip(piece, self._low, self._high))
        return drawn

    def _thinned(self, layer: Layer, random: np.random.Generator) -> Layer:
        """Keep the prefix of greatest worth in each cell, but at most `KEPT` prefixes in total.

        Prefixes are in the same cell if they are of the same kind (see `Layer.kind`) and end in the same
        region of the state space. If there are more than `KEPT` cells, `KEPT` prefixes are drawn at random,
        such that all kinds have about equal shares.
        """
        if not len(layer):
            return layer
        parts = [layer.kind]
        for index, cells in ((self._fine, FINE), (self._coarse, COARSE)):
            ends = layer.states[:, -1, index]
            low, width = ends.min(0), np.maximum(np.ptp(ends, 0), 1e-9)
            parts.append((np.minimum((ends - low) / width, 1.0 - 1e-9) * cells).astype(np.int64))
        order = np.argsort(-layer.worth, kind="stable")
        _, first = np.unique(np.concatenate(parts, 1)[order], axis=0, return_index=True)
        chosen = order[first]
        if len(chosen) > KEPT:
            kind = _numbered(layer.kind[chosen])
            weight = (1.0 + (layer.worth[chosen] >= np.median(layer.worth[chosen]))) / np.bincount(kind)[kind]
            chosen = random.choice(chosen, KEPT, replace=False, p=weight / weight.sum())
        return layer.rows(chosen)


def _numbered(kinds: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number the distinct rows: (rows, entries) -> (rows,), the same number for equal rows."""
    numbers: NDArray[np.int64] = np.unique(kinds, axis=0, return_inverse=True)[1].reshape(-1)
    return numbers
