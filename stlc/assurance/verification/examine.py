"""Examination of batches of boxes, here or in worker processes: samples, bounds, and what is left to examine.

The boxes of a batch belong to one mode. Batches do not depend on each other, and a batch has its own seed, so
the outcome is the same in whatever process it is examined.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Protocol, Self

import numpy as np
import torch

from stlc.assurance.verification.around import narrowed
from stlc.assurance.verification.boxes import Box, Mode
from stlc.assurance.verification.forms import Bools, Floats
from stlc.assurance.verification.judged import PROVED
from stlc.assurance.verification.subject import Indices, VerificationSubject
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.parallel.workers import CallWorkers, LostCall

POINTS = 8
"""States that are sampled in each box: its centre and others at random."""

_TOGETHER = 4
"""Batches of one call, so that workers seldom wait for the process that shares them out."""

_EDGE = 1e-6
"""Volume from which a proved box on the border of `where` is divided, to find its part inside."""


@dataclass(frozen=True, slots=True)
class Witness:
    """Initial state from which the policy's plan violates the specification.

    Attributes:
        state: name of a state -> value.
        robustness: robustness of the selected plan, below 0.
    """

    state: dict[str, float]
    robustness: float


@dataclass(frozen=True, slots=True, eq=False)
class BoxBatch:
    """Boxes of a mode that are examined together.

    Attributes:
        mode: number of the mode.
        boxes: the boxes.
        effects: mean effect of each coordinate on the bounds, (coordinates,), of boxes of width 1.
        seed: seed of the sampled states.
        dive: whether to search a box with a proof around a random state in each box.
    """

    mode: int
    boxes: tuple[Box, ...]
    effects: Floats
    seed: int
    dive: bool = False


@dataclass(slots=True, eq=False)
class BatchResult:
    """Result of a batch; the proved boxes, those that are left, and boxes outside of `where` cover it.

    Attributes:
        proved: boxes with a proof.
        left: parts to examine.
        shares: effects of the coordinates on the bounds of boxes of width 1, relative to their mean; an array
            (coordinates,) for each box without a proof.
        witness: the counterexample with the least robustness; None if none was found.
        seconds: processor time.
    """

    proved: list[Box] = field(default_factory=list)
    left: list[Box] = field(default_factory=list)
    shares: list[Floats] = field(default_factory=list)
    witness: Witness | None = None
    seconds: float = 0.0


class BatchExaminer(Protocol):
    """Interface of what examines batches."""

    def __call__(self, batches: Iterable[BoxBatch]) -> Iterator[BatchResult | LostCall]:
        """Yield the results in order; batches are consumed as they are examined."""


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Verdicts on boxes from sampled states.

    Attributes:
        refuted: whether a state in the box violates the specification, (boxes,).
        hopeless: whether all choices violate it from all sampled states, (boxes,).
        index: number of the choice that is most robust in its worst state, (boxes,).
        hopeful: whether this choice satisfies the specification from all sampled states, (boxes,).
    """

    refuted: Bools
    hopeless: Bools
    index: Indices
    hopeful: Bools


class Examiner:
    """Examination of batches in this process."""

    def __init__(self, plans: VerificationSubject) -> None:
        self._plans = plans

    def __call__(self, batches: Iterable[BoxBatch]) -> Iterator[BatchResult]:
        """Yield the results of batches."""
        for batch in batches:
            yield self.examined(batch)

    def examined(self, batch: BoxBatch) -> BatchResult:
        """Result of one batch."""
        begun, found = time.process_time(), BatchResult()
        rng, mode = np.random.default_rng(batch.seed), self._plans.modes[batch.mode]
        if batch.dive:
            self._dive(found, mode, batch, rng)
        else:
            self._examine(found, mode, batch, rng)
        found.seconds = time.process_time() - begun
        return found

    def _dive(self, found: BatchResult, mode: Mode, batch: BoxBatch, rng: np.random.Generator) -> None:
        """Search boxes that can be proved around a random state in each of some boxes."""
        centre, half = _ends(batch.boxes)
        at = centre + rng.uniform(-1.0, 1.0, half.shape) * half
        x0 = self._plans.states(mode, at)
        good = self._plans.admits(mode, at) & (self._plans.choices(x0).max(1) >= 0.0)
        found.left += [box for box, fine in zip(batch.boxes, good, strict=True) if not fine]
        chosen = np.flatnonzero(good).tolist()
        if chosen:
            boxes = [replace(batch.boxes[i], refuted=False) for i in chosen]
            found.proved += narrowed(self._plans, mode, boxes, at[chosen], others=found.left.append)

    def _examine(self, found: BatchResult, mode: Mode, batch: BoxBatch, rng: np.random.Generator) -> None:
        boxes = self._admitted(mode, batch)
        if not boxes:
            return
        samples = self._sampled(found, mode, boxes, rng)
        for i, box in enumerate(boxes):
            if samples.refuted[i] or not samples.hopeful[i]:
                known = replace(box, refuted=bool(samples.refuted[i]), hopeless=bool(samples.hopeless[i]))
                found.left += known.split(int(np.argmax(batch.effects * box.half)))
        good = np.flatnonzero(samples.hopeful & ~samples.refuted).tolist()
        if not good:
            return
        bounds = self._plans.bound(mode, [boxes[i] for i in good], samples.index[good])
        for row, i in enumerate(good):
            box, effects = replace(boxes[i], refuted=False, hopeless=False), bounds.effects[row]
            if not bounds.low[row] >= -PROVED:  # also without a number
                share = effects / box.half
                found.shares.append(share / share.mean())
                found.left += box.split(int(np.argmax(effects)))
            elif box.inside or box.volume <= _EDGE:
                found.proved.append(box)
            else:  # its part inside of `where` is found by dividing it
                found.left += box.split(int(np.argmax(batch.effects * box.half)))

    def _admitted(self, mode: Mode, batch: BoxBatch) -> list[Box]:
        """The boxes that may contain a state that meets `where`."""
        asked = [box for box in batch.boxes if not box.inside]
        inside = [box for box in batch.boxes if box.inside]
        if not asked:
            return inside
        truth = mode.truths(asked, self._plans.names)
        return inside + [
            replace(box, inside=bool(truth.sure[i])) for i, box in enumerate(asked) if truth.possible[i]
        ]

    def _sampled(
        self, found: BatchResult, mode: Mode, boxes: Sequence[Box], rng: np.random.Generator
    ) -> _Samples:
        """Sample states in boxes; those that do not meet `where` do not count.

        Of the states of a box that all choices violate, the policy plans from the worst.
        """
        centre, half = _ends(boxes)
        moves = rng.uniform(-1.0, 1.0, (POINTS, *centre.shape))
        moves[0] = 0.0
        at = np.clip(centre + moves * half, 0.0, 1.0).reshape(-1, centre.shape[1])
        x0, met = self._plans.states(mode, at), self._plans.admits(mode, at)
        rho = np.where(met[:, None], self._plans.choices(x0), np.inf).reshape(POINTS, len(boxes), -1)
        best, least = rho.max(2), rho.min(0)
        worst = best.argmin(0)
        failing = np.flatnonzero(best.min(0) < -PROVED)
        refuted = np.zeros(len(boxes), dtype=bool)
        if len(failing):
            tried = x0[torch.from_numpy(worst[failing] * len(boxes) + failing)]
            chosen = self._plans.robustness(tried)
            refuted[failing] = TOLERANCE.violated(chosen)
            i = int(np.argmin(chosen))
            if TOLERANCE.violated(chosen[i]):
                state = dict(zip(self._plans.names, tried[i].tolist(), strict=True))
                found.witness = Witness(state, float(chosen[i]))
        index = least.argmax(1)
        hopeful: Bools = least[np.arange(len(boxes)), index] >= -PROVED
        return _Samples(refuted, best.max(0) < -PROVED, index, hopeful)


def _ends(boxes: Sequence[Box]) -> tuple[Floats, Floats]:
    """Centres and half widths of boxes, (boxes, coordinates)."""
    return np.stack([box.centre for box in boxes]), np.stack([box.half for box in boxes])


# --------------------------------------------------------------------------- processes


class SubjectSource(Protocol):
    """Interface of what is verified, for other processes; it can be pickled and compared."""

    def load(self) -> VerificationSubject:
        """Load the subject."""


class SharedExaminer:
    """Examination of batches by worker processes, as a context; each loads the subject once.

    Attributes:
        lost: causes of the losses of batches that were lost with their processes, three times each.
    """

    def __init__(self, source: SubjectSource, calls: CallWorkers) -> None:
        """Use workers that make calls; local ones must be `fresh`, since this process has used PyTorch."""
        self._source, self._calls = source, calls
        self._seconds = 0.0
        self.lost: list[str] = []

    def __enter__(self) -> Self:
        """Return the object; processes start when they are needed."""
        self._calls.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        """End the processes."""
        self._calls.__exit__(*raised)

    def processor_time(self) -> float:
        """Processor time of this process and, divided by their number, of the workers, in seconds."""
        return time.process_time() + self._seconds / self._calls.size

    def __call__(self, batches: Iterable[BoxBatch]) -> Iterator[BatchResult | LostCall]:
        """Yield the results of batches in their order."""
        ended: dict[int, list[BatchResult] | LostCall] = {}
        sent: list[int] = []
        following = 0
        for each in self._calls.results(_call, self._orders(batches, sent)):
            ended[each.index] = each.value
            while following in ended:
                found = ended.pop(following)
                if isinstance(found, LostCall):
                    self.lost += [found.reason] * sent[following]
                    yield from [found] * sent[following]
                else:
                    self._seconds += sum(result.seconds for result in found)
                    yield from found
                following += 1

    def _orders(self, batches: Iterable[BoxBatch], sent: list[int]) -> Iterator[_Order]:
        """Calls of `_TOGETHER` batches each; their sizes are added to `sent`."""
        waiting = iter(batches)
        while chosen := tuple(islice(waiting, _TOGETHER)):
            sent.append(len(chosen))
            yield _Order(self._source, chosen)


@dataclass(frozen=True, slots=True)
class _Order:
    """Batches for a worker process, and the source of their subject."""

    source: SubjectSource
    batches: tuple[BoxBatch, ...]


_loaded: list[tuple[SubjectSource, Examiner]] = []
"""The examiner of a worker process, and the source of its subject."""


def _call(order: _Order) -> list[BatchResult]:
    """Examine batches in a worker process, which has one core."""
    if not _loaded or _loaded[0][0] != order.source:
        torch.set_num_threads(1)
        _loaded[:] = [(order.source, Examiner(order.source.load()))]
    return list(_loaded[0][1](order.batches))
