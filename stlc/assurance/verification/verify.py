"""Branch and bound over the initial states of a trained policy: proofs, counterexamples, and undecided boxes.

A box of initial states is *proved* if one fixed proposal of the network satisfies the specification from
every state in it, by bounds on plan, motion and robustness. The policy selects a plan that satisfies the
specification wherever one of its proposals does (`stlc.controller.problem.task.rank`; performance terms must
be numbers), so its plan satisfies it too. A box is *refuted* if the policy's plan from a sampled state in it
violates the specification. Refuted and other boxes are split in two (Bunel et al. 2018).

The proofs concern the first plan, in the model of the system, from states in float64, with the tolerance of
the monitor.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count, takewhile
from typing import TypeAlias

import numpy as np
import torch

from stlc.assurance.verification.around import Around, StateProver
from stlc.assurance.verification.boxes import Box, Mode, whole
from stlc.assurance.verification.examine import BatchExaminer, BatchResult, BoxBatch, Examiner, Witness
from stlc.assurance.verification.forms import Floats
from stlc.assurance.verification.judged import BoxVerdicts
from stlc.assurance.verification.subject import VerificationSubject

Clock: TypeAlias = Callable[[], float]

DIVES = 16
"""States around which boxes are searched at once."""

LITTLE = 0.01
"""Proved share of a mode up to which boxes around single states are searched."""

ROUND = 64
"""Batches that are chosen at once, and may be examined at the same time."""

HOPELESS = 64.0
"""Boxes of which all samples violate the specification are examined like boxes smaller by this factor."""


@dataclass(slots=True)
class ModeResult:
    """Result for one mode; shares are probabilities within the mode and add up to 1.

    With conditions of `where`, probabilities are conditional on them. `proved` counts only boxes in which
    every state meets the conditions, and divides by an upper bound on the share of drawn states that does
    (`ProposedPlans.acceptance`), so that it is a lower bound. `refuted` counts boxes with a counterexample
    whole.

    Attributes:
        mode: the mode.
        proved: share of proved boxes.
        refuted: share of the boxes that contain a known counterexample.
        open: share of all other boxes.
        boxes: the proved boxes.
        examined: number of boxes that were bounded or refuted.
        witness: the counterexample with the least robustness; None if none was found.
        accepted: share of drawn states that meet `where`, at most; 1 without conditions.
    """

    mode: Mode
    proved: float = 0.0
    refuted: float = 0.0
    open: float = 1.0
    boxes: list[Box] = field(default_factory=list)
    examined: int = 0
    witness: Witness | None = None
    accepted: float = 1.0


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of a verification: one entry per mode, and totals by the probabilities of the modes."""

    modes: tuple[ModeResult, ...]
    seconds: float

    def probability(self, each: ModeResult) -> float:
        """Probability of a mode, given the conditions of `where`; exact without conditions."""
        total = sum(other.mode.weight * other.accepted for other in self.modes)
        return each.mode.weight * each.accepted / total

    @property
    def proved(self) -> float:
        """Probability of an initial state in a proved box, at least."""
        return sum(self.probability(each) * each.proved for each in self.modes)

    @property
    def refuted(self) -> float:
        """Probability of an initial state in a box with a known counterexample."""
        return sum(self.probability(each) * each.refuted for each in self.modes)

    @property
    def open(self) -> float:
        """Probability of all other initial states."""
        return sum(self.probability(each) * each.open for each in self.modes)


class _Front:
    """Boxes of a mode that are left to examine, the largest first.

    Attributes:
        effects: mean effect of each coordinate on the bounds, (coordinates,), of boxes of width 1.
        planned: number of boxes that were taken to be examined.
        dive: whether boxes around single states are searched next.
    """

    def __init__(self, mode: Mode) -> None:
        self.effects = np.ones(len(mode.coordinates))
        self.planned = 0
        self.dive = False
        self._heap: list[tuple[float, int, Box]] = []
        self._numbers = count()
        self.add(whole(mode))

    def __len__(self) -> int:
        return len(self._heap)

    def __iter__(self) -> Iterator[Box]:
        return (box for _, _, box in self._heap)

    @property
    def size(self) -> float:
        """Volume of the next box; of a hopeless one, a `HOPELESS`th of it."""
        return -self._heap[0][0]

    def add(self, box: Box) -> None:
        """Add a box."""
        size = box.volume / HOPELESS if box.hopeless else box.volume
        heapq.heappush(self._heap, (-size, next(self._numbers), box))

    def take(self, most: int) -> tuple[Box, ...]:
        """Remove the largest boxes, `most` at most."""
        return tuple(heapq.heappop(self._heap)[2] for _ in range(min(most, len(self._heap))))

    def learn(self, share: Floats) -> None:
        """Take the relative effects in one box into the mean."""
        self.effects += 0.02 * (share - self.effects)


class Verifier:
    """Branch and bound for one policy or closed loop.

    Args:
        plans: what is verified.
        seed: seed of the sampled states.
        clock: clock of the search.
        examiner: what examines batches of boxes of `plans`; this process if not given.

    Attributes:
        plans: what is verified.
        modes: ways to draw an initial state.
    """

    def __init__(
        self,
        plans: VerificationSubject,
        *,
        seed: int = 0,
        clock: Clock = time.monotonic,
        examiner: BatchExaminer | None = None,
    ) -> None:
        self.plans, self._clock = plans, clock
        self.modes = self.plans.modes
        self._examiner = Examiner(plans) if examiner is None else examiner
        self._rng = np.random.default_rng(seed)

    def run(self, seconds: float, *, boxes: int | None = None, until_refuted: bool = False) -> Verification:
        """Return the result after at most about `seconds` of the clock.

        The mode with the largest box is next, so that all modes are divided into boxes of about one size.
        `boxes` is the number of boxes of each mode that are examined at most; with it, and without a limit
        of the time, the result depends on the seed only. With `until_refuted`, the search ends with the
        first counterexample. Batches that are lost with their process stay open.
        """
        begun = self._clock()
        most = math.inf if boxes is None else boxes
        found = [ModeResult(mode) for mode in self.modes]
        fronts = [_Front(mode) for mode in self.modes]

        def going(_: object = None) -> bool:
            refuted = until_refuted and any(each.witness for each in found)
            return not refuted and self._clock() - begun < seconds

        while going() and (chosen := self._chosen(fronts, most)):
            examined = 0
            batches = takewhile(going, chosen)
            for batch, result in zip(chosen, self._examiner(batches), strict=False):
                examined += 1
                if isinstance(result, BatchResult):
                    self._take(found[batch.mode], fronts[batch.mode], batch, result)
            for batch in chosen[examined:]:  # the search is over
                for box in batch.boxes:
                    fronts[batch.mode].add(box)
        for each, front in zip(found, fronts, strict=True):
            each.accepted = self.plans.acceptance(each.mode)
            sure = sum(box.volume for box in each.boxes if box.inside)
            bad = sum(box.volume for box in front if box.refuted)
            each.proved = min(1.0, sure / each.accepted)
            each.refuted = min(bad / each.accepted, 1.0 - each.proved)
            each.open = max(0.0, 1.0 - each.proved - each.refuted)
        return Verification(tuple(found), self._clock() - begun)

    def _chosen(self, fronts: list[_Front], most: float) -> list[BoxBatch]:
        found: list[BoxBatch] = []
        while len(found) < ROUND:
            ready = [i for i, front in enumerate(fronts) if len(front) and front.planned < most]
            if not ready:
                break
            number = max(ready, key=lambda i: fronts[i].size)
            front = fronts[number]
            boxes = front.take(DIVES if front.dive else self.plans.batch)
            front.planned += len(boxes)
            seed = int(self._rng.integers(2**32))
            found.append(BoxBatch(number, boxes, front.effects.copy(), seed, front.dive))
            front.dive = False
        return found

    def _take(self, result: ModeResult, front: _Front, batch: BoxBatch, found: BatchResult) -> None:
        """Take the result of a batch into that of its mode.

        While little is proved and a batch proves nothing, boxes around single states are next.
        """
        result.examined += len(batch.boxes)
        result.boxes += found.proved
        result.proved += sum(box.volume for box in found.proved if box.inside)
        for box in found.left:
            front.add(box)
        for share in found.shares:
            front.learn(share)
        front.dive = not batch.dive and not found.proved and result.proved < LITTLE and len(front) >= DIVES
        if found.witness is not None and (
            result.witness is None or found.witness.robustness < result.witness.robustness
        ):
            result.witness = found.witness

    def around(self, states: int, *, seed: int = 0) -> list[Around]:
        """Search boxes with a proof around random initial states; one result per mode, in their order."""
        return StateProver(self.plans, seed=seed).run(states)

    # ---------------------------------------------------------------------------- samples

    def states(self, mode: Mode, at: Floats) -> torch.Tensor:
        """Initial states at coordinates (B, coordinates) from 0 to 1: (B, n) float64."""
        return self.plans.states(mode, at)

    def robustness(self, x0: torch.Tensor) -> Floats:
        """Robustness of the plans that the policy selects from states (B, n), (B,)."""
        return self.plans.robustness(x0)

    def bound(self, mode: Mode, boxes: Sequence[Box], index: int) -> BoxVerdicts:
        """Bounds on the robustness of proposal number `index` over boxes of a mode."""
        return self.plans.bound(mode, boxes, index)
