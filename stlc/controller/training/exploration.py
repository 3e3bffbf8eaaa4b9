"""Plans found by exploration: a tree of beginnings, grown from where something new was reached.

A climb changes whole plans, and where many things have to be done one after the other hardly any change
does one more of them without undoing the rest. So plans are put together from their beginnings here. Of
every beginning it is known, from bounds over all that may follow it, which parts of the specification it
has violated for good, which it has satisfied already, and which are open. What has violated one is
dropped. The rest is kept layer by layer (one for every step of the plan), the best of every cell: which
parts are satisfied, and where in the state space it ended. Beginnings that have come far, or that stand
where few others do, are gone on with first (Ecoffet et al. 2021, "First return, then explore").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.problem.native import Effort
from stlc.controller.training.local_search import SearchResult

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from stlc.compile.schedule.schedule import Boundary
    from stlc.controller.problem.task import Task

Numbers = NDArray[np.float64]

CHILDREN = 512
"""Beginnings that are gone on with together."""
KEPT = 512
"""Beginnings that a layer holds, at most."""
FINE, COARSE = 24, 5
"""Cells along a state that the specification reads, and along another one that moves."""
COUNTED = 6
"""Cells along a timer."""
GROWTH = 0.1
"""Mean share of the horizon by which a beginning grows in one go."""
NEAR = 8.0
"""Preference of the nearest prefixes over the farthest, as a power of e."""
EFFORTS = (8, 24, 72)
"""Sweeps of a plan over `USUAL` steps: what is tried first, and what is tried where that found nothing."""
USUAL = 30
"""Steps; what a sweep takes grows with the square of them."""
BATCH = 8
"""Sweeps from one start before the next has its turn."""
TAILS = 8
"""Instants of a plan that was found, from which its rest is a plan too."""
RAISED = 250
"""Generations of a climb that give a plan that was found more to spare."""


def pieces(formula: ir.Formula) -> list[ir.Formula]:
    """Formulas whose conjunction it is: what can be satisfied or violated one by one."""
    match formula:
        case ir.BoolOp("and", items):
            return [piece for item in items for piece in pieces(item)]
        case ir.Temporal("always", _, body):
            return [replace(formula, body=piece) for piece in pieces(body)]
        case _:
            return [formula]


@dataclass(frozen=True, slots=True)
class Layer:
    """Beginnings of the same length, a row each.

    Attributes:
        states: on their way, (rows, steps + 1, n).
        plans: (rows, steps, m).
        met: which pieces are satisfied whatever follows, (rows, pieces).
        kind: the same for beginnings that satisfy the same pieces and whose timers agree, (rows, columns).
        worth: how near the open ones are, (rows,).
        visits: how often each was gone on with, (rows,).
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
        """Some of them."""
        return Layer(*(getattr(self, name)[index] for name in Layer.__slots__))

    def joined(self, other: Layer) -> Layer:
        """The rows of both."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in Layer.__slots__)
        return Layer(*map(np.concatenate, pairs))


@dataclass(frozen=True, slots=True)
class ExplorationResult:
    """Result of the exploration from one start.

    Attributes:
        plan: satisfying, (T, m) float64; None where none was found.
        sweeps: that were made.
    """

    plan: Tensor | None
    sweeps: int


class Exploration:
    """Explores the plans of one task, from one start at a time.

    Attributes:
        task: specification and system.
        pieces: formulas whose conjunction the specification is.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.pieces = tuple(dict.fromkeys(part for rule in task.rules for part in pieces(rule.formula)))
        system = task.system
        self._low, self._high = (
            bound.double().numpy(force=True) for bound in (system.control_low, system.control_high)
        )
        self._turns = np.array([control.squash == "angle" for control in system.controls])
        read = frozenset[str]().union(*(columns(piece) for piece in self.pieces))
        kinds = {timer.name: timer.kind for timer in system.timers}
        moving = system.exact_step.next.keys()
        free = [name for name in task.names if name in moving and name not in kinds]
        self._fine = [task.names.index(name) for name in free if name in read]
        self._coarse = [task.names.index(name) for name in free if name not in read]
        counts = [timer for timer in system.timers if timer.kind in ("timer", "latch")]
        self._counts = [task.names.index(timer.name) for timer in counts]
        self._cells = np.array([max((timer.high - timer.low) / COUNTED, 1.0) for timer in counts])

    def plan(
        self,
        x: Tensor,
        sweeps: int,
        generator: torch.Generator,
        enough: Callable[[], bool] = lambda: False,
    ) -> ExplorationResult:
        """A satisfying plan from the state (n,), as far as one was found.

        Args:
            x: the start.
            sweeps: how often the beginnings of every length are gone on with, at most.
            generator: of the choices.
            enough: asked before each sweep after the first; True gives up.
        """
        random = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        start = x.double().numpy(force=True)[None, None]
        layers = [self._begun(start, np.empty((1, 0, len(self._low))))]
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
        """Plans that were found from some of the starts (k, n), and what is left of them on their way.

        Every start has its turn while there is effort left. Where the specification has memory, states on the
        way of a plan are starts of their own, and the rest of the plan may solve them.

        Args:
            starts: (k, n).
            sweeps: in all, for a plan over `USUAL` steps; fewer of a longer one.
            generator: of the choices.
            spare: robustness up to which the plans are raised.
            enough: asked now and then; True ends it.
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
                found.append(self._on_its_way(x, self._raised(x, tried.plan.to(x.dtype), spare)))
        return SearchResult(
            *(torch.cat([getattr(part, name) for part in found]) for name in SearchResult.__slots__)
        )

    # ------------------------------------------------------------------ plans that were found

    def _raised(self, x: Tensor, plan: Tensor, spare: float) -> Tensor:
        """The plan (T, m), or a change of it that has more to spare."""
        if self.task.native is None:
            return plan
        effort = Effort(RAISED, spare, 0)
        return self.task.native.climb(x[None], plan[None], plan[None], effort)[0][0]

    def _on_its_way(self, x: Tensor, plan: Tensor) -> SearchResult:
        """The start with its plan, and those states on its way whose rest of the plan solves them."""
        states, plans = [x], [plan]
        if self.task.compiled.timers:
            path = self.task.rollout(x[None], plan[None])[0]
            for step in range(0, len(plan), -(-len(plan) // TAILS))[1:]:
                states.append(path[step])
                plans.append(torch.cat((plan[step:], plan[-1:].expand(step, -1))))
        x0, u = torch.stack(states), torch.stack(plans)
        judged = SearchResult(x0, u, self.task.judge(x0, u, states=False).rho)
        good = judged.solved
        return SearchResult(judged.states[good], judged.plans[good], judged.rho[good])

    def _best(self, x: Tensor, layer: Layer) -> Tensor:
        plans = torch.from_numpy(layer.plans)
        rho = self.task.judge(x.double().cpu().expand(len(plans), -1), plans, states=False).rho
        return plans[int(rho.argmax())]

    # ------------------------------------------------------------------ beginnings

    def _grown(self, layer: Layer, random: np.random.Generator) -> Layer:
        """Continuations of some prefixes of a layer that may still satisfy the specification."""
        chosen = self._chosen(layer, random)
        np.add.at(layer.visits, chosen, 1.0)
        horizon, before = self.task.horizon, layer.plans[chosen]
        more = min(horizon - before.shape[1], 1 + int(random.exponential(GROWTH * horizon)))
        piece, states = self._drawn(before, more, random), layer.states[chosen]
        with torch.no_grad():
            after = self.task.rollout(torch.from_numpy(states[:, -1]), torch.from_numpy(piece)).numpy()
        return self._begun(np.concatenate((states, after[:, 1:]), 1), np.concatenate((before, piece), 1))

    def _begun(self, states: Numbers, plans: Numbers) -> Layer:
        """Prefixes, of some, that may still satisfy the specification."""
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
        """Of the robustness of every piece, over all that may follow: (rows, samples, n) -> (rows, k)."""
        if not len(states):
            return np.empty((0, len(self.pieces)))
        env = dict(zip(self.task.names, np.moveaxis(states, (0, 1, 2), (2, 1, 0)), strict=True))
        stop = None if end == "strict" else self.task.horizon + 1
        found = evaluate(self.pieces, env, ops=NUMPY, end=end, stop=stop)
        return np.stack([np.broadcast_to(each[0], len(states)) for each in found], 1)

    def _chosen(self, layer: Layer, random: np.random.Generator) -> NDArray[np.int64]:
        """Prefixes to continue, (CHILDREN,): those with more pieces met, the nearest and the rarest first."""
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
        """Controls that may follow, (rows, more, m): levels, ends of ranges, changes of the last, noise."""
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
        """The nearest of every cell, and `KEPT` at most, as many of each kind as there is room for."""
        if not len(layer):
            return layer
        parts = [layer.kind]
        for index, cells in ((self._fine, FINE), (self._coarse, COARSE)):
            ends = layer.states[:, -1, index]
            low, width = ends.min(0), np.maximum(np.ptp(ends, 0), 1e-9)
            parts.append((np.minimum((ends - low) / width, 1.0 - 1e-9) * cells).astype(np.int64))
        order = np.argsort(-layer.worth, kind="stable")
        _, first = np.unique(np.concatenate(parts, 1)[order], axis=0, return_index=True)
        kept = order[first]
        if len(kept) > KEPT:
            kind = _numbered(layer.kind[kept])
            weight = (1.0 + (layer.worth[kept] >= np.median(layer.worth[kept]))) / np.bincount(kind)[kind]
            kept = random.choice(kept, KEPT, replace=False, p=weight / weight.sum())
        return layer.rows(kept)


def _numbered(kinds: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number per row, the same for equal rows."""
    numbers: NDArray[np.int64] = np.unique(kinds, axis=0, return_inverse=True)[1].reshape(-1)
    return numbers
