"""Robustness margins of many growing traces, all evaluated together; for one trace, see `Online`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir.support import columns_in, history
from stlc.compile.semantics.tolerance import StatusInScope, satisfied, status_of, violated
from stlc.monitor.instants import window_of
from stlc.monitor.online.history import ColumnHistory, Floats
from stlc.monitor.online.recompute import RecomputeTracker

if TYPE_CHECKING:
    from stlc.compile.pipeline import CompiledRequirement

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
        return status_of(bool(self.violated[trace]), not self.open[trace])


@dataclass(slots=True)
class _Watched:
    """A requirement, and the number of its violations on each trace.

    A window start is a sample at which the requirement is evaluated. It is settled if later samples can no
    longer change the robustness there.

    Attributes:
        everywhere: whether the requirement is evaluated at every sample or only at the first one.
        ahead: number of later samples on which the value at an instant depends; None if it depends on all.
        next: the first window start that is not settled; all earlier window starts are settled.
        violated: number of settled window starts that are violated, (traces,) or 0.
        last: margins at the latest sample; None before the first evaluation.
    """

    rule: CompiledRequirement
    tracker: RecomputeTracker
    everywhere: bool
    ahead: int | None
    next: int = 0
    violated: Counts | int = 0
    last: Margin | None = None

    @classmethod
    def of(cls, rule: CompiledRequirement, horizon: int | None) -> _Watched:
        everywhere = rule.windowed and not rule.absolute and horizon is not None
        moving = window_of(rule, horizon)
        ahead = max(rule.reach, moving or 0, (horizon or 0) if everywhere else 0)
        to_end = rule.uses_end and moving is None
        return cls(rule, RecomputeTracker(rule, horizon, "open"), everywhere, None if to_end else ahead)

    @property
    def needs(self) -> int:
        """Index of the first sample that later evaluations read."""
        return max(self.next - history(self.rule.formula), 0) if self.everywhere else 0

    def evaluate(self, env: Mapping[str, Floats], first: int, samples: int) -> Margin:
        """Return the margin of the requirement at the latest of `samples` samples.

        `env` maps each signal to its stored samples, (stored, traces), from sample `first` on.
        """
        if self.last is not None and self.next and not self.everywhere:
            return self.last
        stop = samples if self.everywhere else 1
        begin = max(self.needs, first)  # a constant number of samples: its schedule is cached
        self.tracker.grow({name: column[begin - first :] for name, column in env.items()}, 0, samples - begin)
        shape = (stop - self.next, next(iter(env.values())).shape[1])
        low, high = (
            np.broadcast_to(end, shape) for end in self.tracker.live(range(self.next - begin, stop - begin))
        )
        fails, holds = violated(high), satisfied(low)
        whole = 0 if self.ahead is None else max(samples - self.ahead, 0)  # instants with complete windows
        shown = max(whole - 1 - self.next, 0) if self.everywhere else 0
        undecided = np.logical_or.reduce(~fails & ~holds, axis=0)
        self.last = Margin(low[shown:].min(0), high[shown:].min(0), self.violated + fails.sum(0), undecided)
        settled = min(whole, stop) - self.next
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
        self._watched = [_Watched.of(rule, horizon) for rule in rules]
        self._names = sorted({name for rule in rules for name in columns_in(rule.formula)})
        self._history = ColumnHistory()
        self._found: dict[str, Margin] = {}
        self._evaluated = 0

    @property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements, in order."""
        return tuple(watched.rule.name for watched in self._watched)

    @property
    def samples(self) -> int:
        """Number of samples received."""
        return self._history.samples

    def push(self, signals: Mapping[str, Floats]) -> None:
        """Add one sample of every trace: signal name -> values (traces,)."""
        names = self._names or list(signals)[:1]
        self._history.take({name: np.asarray(signals[name])[None] for name in names}, 1)

    def evaluate(self) -> dict[str, Margin]:
        """Return the margins of every requirement at the latest sample; needs at least one sample."""
        if self._evaluated != self.samples:
            env, first = self._history.columns(), self._history.first
            found = [each.evaluate(env, first, self.samples) for each in self._watched]
            self._found, self._evaluated = dict(zip(self.requirements, found, strict=True)), self.samples
            self._history.forget(min([each.needs for each in self._watched], default=self.samples))
        return self._found
