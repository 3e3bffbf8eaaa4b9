"""Robustness margins of many growing traces, all evaluated together; for one trace, see `Online`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir.support import columns, history
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.monitor.instants import window_of
from stlc.monitor.judgement import Status
from stlc.monitor.online.history import ColumnHistory
from stlc.monitor.online.trackers import RecomputeTracker

if TYPE_CHECKING:
    from stlc.compile.pipeline import CompiledRequirement

Floats: TypeAlias = NDArray[np.float64]
Counts: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Margin:
    """Bounds on the robustness margin of a requirement at the latest sample, (traces,) each.

    A window start is a sample at which the requirement is evaluated.

    Attributes:
        low: least robustness over all continuations of the trace. If the requirement is evaluated at every
            sample, this is the minimum over the windows that contain the latest sample.
        high: greatest robustness over all continuations. If the requirement is evaluated at every sample,
            this is the minimum over the same windows.
        violated: number of window starts at which the requirement is certainly violated.
        open: whether the requirement is undecided at any window start.
    """

    low: Floats
    high: Floats
    violated: Counts
    open: NDArray[np.bool_]

    def status(self, trace: int) -> Status:
        """Status of one trace: `violated`, `satisfied` or `inconclusive`.

        The status is violated if the requirement is violated at any window start, and satisfied if the
        requirement is satisfied at every window start.
        """
        if self.violated[trace]:
            return "violated"
        return "inconclusive" if self.open[trace] else "satisfied"


@dataclass(slots=True)
class _Watched:
    """A requirement, and the number of its violations on each trace.

    A window start is a sample at which the requirement is evaluated. It is settled if later samples can no
    longer change the robustness there.

    Attributes:
        rule: the requirement.
        horizon: horizon `T` of the planning window in steps; None if unknown.
        whole: evaluator of the bounds over all continuations of the traces.
        next: the first window start that is not settled; all earlier window starts are settled.
        violated: number of settled window starts that are violated, (traces,).
        last: margins at the latest sample; None before the first evaluation.
    """

    rule: CompiledRequirement
    horizon: int | None
    whole: RecomputeTracker
    next: int = 0
    violated: Counts = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    last: Margin | None = None

    @property
    def everywhere(self) -> bool:
        """True if the requirement is evaluated at every sample, False if only at the first one."""
        return self.rule.windowed and not self.rule.absolute and self.horizon is not None

    @property
    def ahead(self) -> int | None:
        """Number of later samples on which the value at an instant depends.

        None if the value depends on all samples up to the end of the trace.
        """
        moving = window_of(self.rule, self.horizon)
        if moving is not None:
            return max(moving, self.rule.reach)
        if self.rule.uses_end:
            return None
        counted = self.horizon if self.everywhere else None
        return max(self.rule.reach, counted or 0)

    def needs(self) -> int:
        """Index of the first sample that later evaluations read."""
        if not self.everywhere:
            return 0
        return max(self.next - history(self.rule.formula), 0)

    def evaluate(self, env: Mapping[str, Floats], first: int, samples: int) -> Margin:
        """Return the margin of the requirement at the latest sample.

        The attributes `violated`, `next` and `last` are updated.

        Args:
            env: signal -> its stored samples, (stored, traces), beginning with sample `first`.
            first: index of the first stored sample.
            samples: number of samples received; the latest one has the index `samples` - 1.
        """
        if not self.everywhere and self.next:
            assert self.last is not None
            return self.last
        stop = samples if self.everywhere else 1
        begin = max(self.needs(), first)  # a constant number of samples: its schedule is cached
        starts = range(self.next - begin, stop - begin)
        self.whole.grow({name: column[begin - first :] for name, column in env.items()}, 0, samples - begin)
        shape = (len(starts), next(iter(env.values())).shape[1])
        low, high = (np.broadcast_to(end, shape) for end in self.whole.of_all(starts))
        fails, holds = high < -TOLERANCE, low >= -TOLERANCE
        if len(self.violated) != low.shape[1]:
            self.violated = np.zeros(low.shape[1], dtype=np.int64)
        shown = self._shown(samples)
        self.last = Margin(
            low[shown:].min(0),
            high[shown:].min(0),
            self.violated + fails.sum(0),
            np.logical_or.reduce(~fails & ~holds, axis=0),
        )
        settled = self._settled(samples) - self.next
        if settled > 0:
            self.violated = self.violated + fails[:settled].sum(0)
            self.next += settled
        return self.last

    def _settled(self, samples: int) -> int:
        """Index of the first window start whose robustness may still change after `samples` samples."""
        if self.ahead is None:
            return 0
        whole = max(samples - self.ahead, 0)
        return whole if self.everywhere else min(whole, 1)

    def _shown(self, samples: int) -> int:
        """Number of samples after `next` whose windows have ended; the margin leaves them out."""
        if not self.everywhere or self.ahead is None:
            return 0
        return max(samples - 1 - self.ahead - self.next, 0)


class Margins:
    """Robustness margins of every requirement on many traces that grow together.

    Memory is bounded by the windows of the requirements, except for requirements that read the whole trace.
    `push` only stores a sample. `evaluate` processes all samples stored since its previous call.

    Args:
        rules: compiled requirements.
        horizon: horizon `T` of the planning window in steps; None if unknown.
    """

    def __init__(self, rules: Sequence[CompiledRequirement], horizon: int | None) -> None:
        self._watched = [_Watched(rule, horizon, RecomputeTracker(rule, horizon, "open")) for rule in rules]
        self._names = sorted({name for rule in rules for name in columns(rule.formula)})
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
            self._history.forget(min([each.needs() for each in self._watched], default=self.samples))
        return self._found
