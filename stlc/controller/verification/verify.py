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

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
import torch

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.verification.around import Around, StateProver, narrowed
from stlc.controller.verification.boxes import Box, Mode, whole
from stlc.controller.verification.forms import Bools, Floats
from stlc.controller.verification.judged import PROVED, BoxVerdicts
from stlc.controller.verification.subject import Indices, VerificationSubject

Clock: TypeAlias = Callable[[], float]

DIVES = 16
"""States around which boxes are searched at once."""

LITTLE = 0.01
"""Proved share of a mode up to which boxes around single states are searched."""

POINTS = 8
"""States that are sampled in each box: its centre and others at random."""

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


@dataclass(slots=True)
class _Front:
    """Boxes of a mode that are left to examine.

    Attributes:
        queue: the boxes, the oldest and so the largest first.
        effects: mean effect of each coordinate on the bounds, (coordinates,), of boxes of width 1.
    """

    queue: deque[Box]
    effects: Floats

    def take(self, count: int) -> list[Box]:
        """Take the oldest boxes, `count` at most."""
        return [self.queue.popleft() for _ in range(min(count, len(self.queue)))]

    def split(self, box: Box, axis: int | None = None) -> None:
        """Add the two halves of a box, along the coordinate `axis`, or that with the greatest mean effect."""
        self.queue.extend(box.split(int(np.argmax(self.effects * box.half)) if axis is None else axis))

    def learn(self, box: Box, effects: Floats) -> None:
        """Take the effects in one box into the mean."""
        share = effects / (effects.sum() * box.half)
        self.effects += 0.02 * (share / share.mean() - self.effects)


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Verdicts on boxes from sampled states.

    Attributes:
        refuted: whether a state in the box violates the specification, (boxes,).
        index: number of the proposal that is most robust in its worst state, (boxes,).
        hopeful: whether this proposal satisfies the specification from all sampled states, (boxes,).
    """

    refuted: Bools
    index: Indices
    hopeful: Bools


class Verifier:
    """Branch and bound for one policy or closed loop.

    Attributes:
        plans: what is verified.
        modes: ways to draw an initial state.
    """

    def __init__(self, plans: VerificationSubject, *, seed: int = 0, clock: Clock = time.monotonic) -> None:
        self.plans, self._clock = plans, clock
        self.modes = self.plans.modes
        self._names = self.plans.names
        self._rng = np.random.default_rng(seed)

    def run(self, seconds: float, *, boxes: int | None = None, until_refuted: bool = False) -> Verification:
        """Return the result after at most about `seconds` of the clock.

        The mode with the largest box is next, so that all modes are divided into boxes of about one size.
        `boxes` is the number of boxes of each mode that are examined at most. With `until_refuted`, the
        search ends with the first counterexample.
        """
        begun = self._clock()
        most = math.inf if boxes is None else boxes
        results = [ModeResult(mode) for mode in self.modes]
        fronts = [_Front(deque([whole(mode)]), np.ones(len(mode.coordinates))) for mode in self.modes]
        while self._clock() - begun < seconds:
            ready = [i for i, each in enumerate(results) if fronts[i].queue and each.examined < most]
            if not ready or (until_refuted and any(each.witness for each in results)):
                break
            largest = max(ready, key=lambda i: fronts[i].queue[0].volume)
            self._advance(results[largest], fronts[largest])
        for result, front in zip(results, fronts, strict=True):
            self._close(result, front)
        return Verification(tuple(results), self._clock() - begun)

    def _close(self, result: ModeResult, front: _Front) -> None:
        """Compute the shares of a mode at the end."""
        result.accepted = self.plans.acceptance(result.mode)
        sure = sum(box.volume for box in result.boxes if box.inside)
        bad = sum(box.volume for box in front.queue if box.refuted)
        result.proved = min(1.0, sure / result.accepted)
        result.refuted = min(bad / result.accepted, 1.0 - result.proved)
        result.open = max(0.0, 1.0 - result.proved - result.refuted)

    def _advance(self, result: ModeResult, front: _Front) -> None:
        """Examine one batch of boxes of a mode, and search around states in some while little is proved."""
        self._examine(result, front, front.take(self.plans.batch))
        if result.proved < LITTLE and len(front.queue) >= DIVES:
            self._dive(result, front, front.take(DIVES))

    def _dive(self, result: ModeResult, front: _Front, taken: Sequence[Box]) -> None:
        """Search boxes that can be proved around a random state in each of some boxes."""
        half = np.stack([box.half for box in taken])
        at = np.stack([box.centre for box in taken]) + self._rng.uniform(-1.0, 1.0, half.shape) * half
        x0 = self.states(result.mode, at)
        good = self.plans.admits(result.mode, at) & (self.plans.choices(x0).max(1) >= 0.0)
        front.queue.extend(box for box, fine in zip(taken, good, strict=True) if not fine)
        chosen = np.flatnonzero(good).tolist()
        if len(chosen):
            boxes = [replace(taken[i], refuted=False) for i in chosen]
            proved = narrowed(self.plans, result.mode, boxes, at[chosen], spare=front.queue.append)
            result.boxes += proved
            result.proved += sum(box.volume for box in proved)
            result.examined += len(boxes)

    def _examine(self, result: ModeResult, front: _Front, taken: Sequence[Box]) -> None:
        boxes = self._admitted(result.mode, taken, front)
        result.examined += len(taken)
        if not boxes:
            return
        samples = self._sampled(result, boxes)
        for i, box in enumerate(boxes):
            if samples.refuted[i] or not samples.hopeful[i]:
                front.split(replace(box, refuted=bool(samples.refuted[i])))
        good = np.flatnonzero(samples.hopeful & ~samples.refuted).tolist()
        if not good:
            return
        found = self.plans.bound(result.mode, [boxes[i] for i in good], samples.index[good])
        for row, i in enumerate(good):
            box, least, effects = boxes[i], float(found.low[row]), found.effects[row]
            if least < -PROVED:
                front.learn(box, effects)
                box = replace(box, refuted=False)
                front.split(box, int(np.argmax(effects)))
            elif box.inside or box.volume <= _EDGE:
                result.boxes.append(box)
                result.proved += box.volume * box.inside
            else:  # its part inside of `where` is found by dividing it
                front.split(replace(box, refuted=False))

    def _admitted(self, mode: Mode, boxes: Sequence[Box], front: _Front) -> list[Box]:
        """The boxes that may contain a state that meets `where`."""
        asked = [box for box in boxes if not box.inside]
        if not asked:
            return list(boxes)
        found = [box for box in boxes if box.inside]
        try:
            truth = mode.truths(asked, self._names)
        except ValueError:
            for box in asked:
                front.split(box, int(np.argmax(box.half)))
            return found
        return found + [
            replace(box, inside=bool(truth.sure[i])) for i, box in enumerate(asked) if truth.possible[i]
        ]

    def around(self, states: int, *, seed: int = 0) -> list[Around]:
        """Search boxes with a proof around random initial states; one result per mode that was drawn."""
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

    def _sampled(self, result: ModeResult, boxes: Sequence[Box]) -> _Samples:
        """Sample states in boxes; those that do not meet `where` do not count."""
        centre, half = np.stack([b.centre for b in boxes]), np.stack([b.half for b in boxes])
        moves = self._rng.uniform(-1.0, 1.0, (POINTS, *centre.shape))
        moves[0] = 0.0
        at = np.clip(centre + moves * half, 0.0, 1.0).reshape(-1, centre.shape[1])
        x0 = self.states(result.mode, at)
        met = self.plans.admits(result.mode, at)
        rho = np.where(met[:, None], self.plans.choices(x0), np.inf)
        failing = np.flatnonzero(rho.max(1) < -PROVED)
        least = rho.reshape(POINTS, len(boxes), -1).min(0)
        refuted = np.zeros(len(at), dtype=bool)
        if len(failing):
            chosen = self.robustness(x0[torch.from_numpy(failing)])
            refuted[failing] = chosen < -TOLERANCE
            self._witness(result, x0[failing[int(np.argmin(chosen))]], float(chosen.min()))
        index = least.argmax(1)
        hopeful: Bools = least[np.arange(len(boxes)), index] >= -PROVED
        return _Samples(np.any(refuted.reshape(POINTS, -1), axis=0), index, hopeful)

    def _witness(self, result: ModeResult, state: torch.Tensor, rho: float) -> None:
        if rho < -TOLERANCE and (result.witness is None or rho < result.witness.robustness):
            result.witness = Witness(dict(zip(self._names, state.tolist(), strict=True)), rho)
