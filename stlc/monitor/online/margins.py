"""Robustness margins of many growing traces side by side: the bounds of `Online`, for all traces at once."""

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
    """Bounds of a requirement at the present sample of every trace, (traces,) each.

    Attributes:
        low: least robustness over all continuations, the least over the windows that contain this sample;
            for a requirement that is evaluated once, over its one window.
        high: greatest robustness over all continuations, the least over the same windows.
        violated: number of starts at which it is already violated, whatever follows.
        open: whether a start so far is still undecided.
    """

    low: Floats
    high: Floats
    violated: Counts
    open: NDArray[np.bool_]

    def status(self, trace: int) -> Status:
        """Violated if it is at one start, satisfied if it is at all starts so far."""
        if self.violated[trace]:
            return "violated"
        return "inconclusive" if self.open[trace] else "satisfied"


@dataclass(slots=True)
class _Watched:
    """A requirement and its running counts: starts before `next` are settled.

    Attributes:
        rule: the requirement.
        horizon: value of `T`, in steps.
        whole: tracker of its bounds, wherever the traces end.
        next: the first start that is not settled.
        violated: settled starts that are violated, (traces,).
        last: the least margins of the windows that closed with the last sample; None before there is one.
    """

    rule: CompiledRequirement
    horizon: int | None
    whole: RecomputeTracker
    next: int = 0
    violated: Counts = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    last: Margin | None = None

    @property
    def everywhere(self) -> bool:
        """True if it is evaluated at every start, and not only at the first sample."""
        return self.rule.windowed and not self.rule.absolute and self.horizon is not None

    @property
    def ahead(self) -> int | None:
        """Lookahead in samples; None where the end of the trace decides it."""
        moving = window_of(self.rule, self.horizon)
        if moving is not None:
            return max(moving, self.rule.reach)
        if self.rule.uses_end:
            return None
        counted = self.horizon if self.everywhere else None
        return max(self.rule.reach, counted or 0)

    def needs(self) -> int:
        """The first sample that is still read."""
        if not self.everywhere:
            return 0
        return max(self.next - history(self.rule.formula), 0)

    def evaluate(self, env: Mapping[str, Floats], first: int, samples: int) -> Margin:
        """The margin at the last of `samples` samples; `env` (stored, traces) begins with sample `first`."""
        if not self.everywhere and self.next:
            assert self.last is not None
            return self.last
        stop = samples if self.everywhere else 1
        begin = max(self.needs(), first)  # a constant number of samples: its schedule is cached
        starts = range(self.next - begin, stop - begin)
        self.whole.grow({name: column[begin - first :] for name, column in env.items()}, 0, samples - begin)
        shape = (len(starts), _traces(env))
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
        """The first start whose value may still change."""
        if self.ahead is None:
            return 0
        whole = max(samples - self.ahead, 0)
        return whole if self.everywhere else min(whole, 1)

    def _shown(self, samples: int) -> int:
        """The first start that is not settled and whose window holds the last sample."""
        if not self.everywhere or self.ahead is None:
            return 0
        return max(samples - 1 - self.ahead - self.next, 0)


class Margins:
    """Robustness margins of every requirement on many traces that grow together.

    Memory is bounded by the windows of the requirements, except those that read the whole trace. `push` only
    stores the sample; `evaluate` takes all samples since the last call, and all traces, in one evaluation.

    Args:
        rules: compiled requirements.
        horizon: value of `T`, in steps.
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
        """Number of samples taken in."""
        return self._history.samples

    def push(self, signals: Mapping[str, Floats]) -> None:
        """Take in one sample of every trace: (traces,) by name."""
        names = self._names or list(signals)[:1]
        self._history.take({name: np.asarray(signals[name])[None] for name in names}, 1)

    def evaluate(self) -> dict[str, Margin]:
        """Return the margins of every requirement at the last sample; there has to be one."""
        if self._evaluated != self.samples:
            env, first = self._history.columns(), self._history.first
            found = [each.evaluate(env, first, self.samples) for each in self._watched]
            self._found, self._evaluated = dict(zip(self.requirements, found, strict=True)), self.samples
            self._history.forget(min([each.needs() for each in self._watched], default=self.samples))
        return self._found


def _traces(env: Mapping[str, Floats]) -> int:
    return int(next(iter(env.values())).shape[1])
