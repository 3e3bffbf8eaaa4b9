"""Robustness margins of many growing traces, all evaluated together; for one trace, see `Online`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.tolerance import TOLERANCE, StatusInScope
from stlc.monitor.online.history import ColumnHistory, Floats
from stlc.monitor.online.recompute import GrowingBounds
from stlc.monitor.online.tally import Asked

Counts: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Margin:
    """Bounds on the robustness margin of a requirement at the latest sample, (traces,) each.

    A window start is a sample at which the requirement is evaluated.

    Attributes:
        low: least robustness over all continuations of the trace. If the requirement is evaluated at every
            sample, this is the minimum over the windows that contain the latest sample.
        high: greatest robustness over all continuations, or its minimum over the same windows.
        violated: number of window starts at which the requirement is certainly violated.
        open: whether the requirement is undecided at any window start.
    """

    low: Floats
    high: Floats
    violated: Counts
    open: NDArray[np.bool_]

    def status(self, trace: int) -> StatusInScope:
        """Violated if violated at any window start of the trace, satisfied if at none and none is open."""
        return TOLERANCE.status(bool(self.violated[trace]), not self.open[trace])


@dataclass(slots=True)
class _Watched:
    """A requirement, and the number of its violations on each trace.

    A window start is a sample at which the requirement is evaluated. It is settled if later samples can no
    longer change the robustness there.

    Attributes:
        asked: the requirement.
        next: the first window start that is not settled; all earlier window starts are settled.
        violated: number of settled window starts that are violated, (traces,) or 0.
        last: margins at the latest sample; None before the first evaluation.
    """

    asked: Asked
    next: int = 0
    violated: Counts | int = 0
    last: Margin | None = None

    @property
    def bounds(self) -> GrowingBounds:
        """Bounds on the requirement."""
        return GrowingBounds(self.asked.rule, self.asked.horizon, self.asked.ending)

    def evaluate(self, history: ColumnHistory) -> Margin:
        """Return the margin of the requirement at the latest sample."""
        samples, bounds, everywhere = history.samples, self.bounds, self.asked.everywhere
        if self.last is not None and self.next and not everywhere:
            return self.last
        begin = max(bounds.needs(self.next), history.first)  # a constant number of samples: plans are cached
        env, starts = history.columns(begin), self.asked.starts(self.next, samples)
        shape = (len(starts), next(iter(env.values())).shape[1])
        found = bounds.live(env, range(starts.start - begin, starts.stop - begin))
        low, high = (np.broadcast_to(end, shape) for end in found)
        fails, holds = TOLERANCE.violated(high), TOLERANCE.satisfied(low)
        whole = max(min(bounds.settled(samples), samples - self.asked.lag), 0)  # with complete windows
        shown = max(whole - 1 - self.next, 0) if everywhere else 0
        undecided = np.logical_or.reduce(~fails & ~holds, axis=0)
        self.last = Margin(low[shown:].min(0), high[shown:].min(0), self.violated + fails.sum(0), undecided)
        settled = min(whole, starts.stop) - self.next
        if settled > 0:
            self.violated = self.violated + fails[:settled].sum(0)
            self.next += settled
        return self.last


class Margins:
    """Robustness margins of every requirement on many traces that grow together.

    Memory is bounded by the windows of the requirements, except for requirements that read the whole trace.
    `push` only stores a sample. `evaluate` processes all samples stored since its previous call.

    Args:
        rules: compiled requirements.
        horizon: horizon `T` of the planning window in steps; None if unknown.
    """

    def __init__(self, rules: Sequence[CompiledRequirement], horizon: int | None) -> None:
        self._watched = {
            rule.name: _Watched(
                Asked(rule, rule, 0, rule.windowed and not rule.absolute and horizon is not None, horizon)
            )
            for rule in rules
        }
        self._names = sorted({name for rule in rules for name in rule.formula.columns})
        self._history = ColumnHistory()
        self._found: dict[str, Margin] = {}
        self._evaluated = 0

    def push(self, signals: Mapping[str, Floats]) -> None:
        """Add one sample of every trace: signal name -> values (traces,)."""
        names = self._names or list(signals)[:1]
        self._history.take({name: np.asarray(signals[name])[None] for name in names})

    def evaluate(self) -> dict[str, Margin]:
        """Return the margins of every requirement at the latest sample; needs at least one sample."""
        if self._evaluated != self._history.samples:
            self._found = {name: each.evaluate(self._history) for name, each in self._watched.items()}
            self._evaluated = self._history.samples
            needs = [each.bounds.needs(each.next) for each in self._watched.values()]
            self._history.forget(min(needs, default=self._evaluated))
        return self._found
