"""Boxes with a proof around random initial states: the share of all states that have one, statistically.

Dividing the whole initial set takes a number of boxes that grows exponentially with its coordinates. Around
one state it does not: a box that cannot be proved is halved, and the half that contains the state is kept.
The states are independent, so their number with a proof bounds the share of states that have one
(`stlc.assurance.bounds.clopper_pearson_lower`); in each box the proof is for every state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stlc.assurance.verification.boxes import Box, Mode
from stlc.assurance.verification.forms import Floats
from stlc.assurance.verification.judged import PROVED
from stlc.assurance.verification.subject import VerificationSubject
from stlc.compile.semantics.tolerance import TOLERANCE

FIRST = 8
"""Boxes along each coordinate that the search around a state begins with."""

HALVINGS = 7
"""Halvings of each coordinate, on average, after which a state stays open."""

_BATCH = 256
"""Boxes that are bounded at once."""


@dataclass(slots=True)
class Around:
    """Result for random states of one mode.

    Attributes:
        mode: the mode.
        states: number of states.
        violated: number of states from which the policy's plan violates the specification.
        boxes: the proved boxes; each is around one of the other states.
    """

    mode: Mode
    states: int
    violated: int
    boxes: list[Box]

    @property
    def proved(self) -> int:
        """Number of states with a proved box around them."""
        return len(self.boxes)


class StateProver:
    """Search for boxes with a proof around random initial states of a policy."""

    def __init__(self, plans: VerificationSubject, *, seed: int = 0) -> None:
        self._plans = plans
        self._rng = np.random.default_rng(seed)

    def run(self, states: int) -> list[Around]:
        """Draw initial states, with the conditions of `where`, and search boxes around them.

        There is one result for each mode, in their order; modes may have equal names.
        """
        modes = self._plans.modes
        weights = np.array([mode.weight for mode in modes])
        drawn: list[list[Floats]] = [[] for _ in modes]
        count = 0
        while count < states:
            number = int(self._rng.choice(len(modes), p=weights / weights.sum()))
            at = self._rng.random(len(modes[number].coordinates))
            if self._plans.admits(modes[number], at[None])[0]:
                drawn[number].append(at)
                count += 1
        return [
            self._around(mode, np.array(at)) if at else Around(mode, 0, 0, [])
            for mode, at in zip(modes, drawn, strict=True)
        ]

    def _around(self, mode: Mode, at: Floats) -> Around:
        """Search boxes around the states with coordinates `at`, (states, coordinates)."""
        x0 = self._plans.states(mode, at)
        good = TOLERANCE.satisfied(self._plans.robustness(x0))
        found = Around(mode, len(at), int((~good).sum()), [])
        inside = np.clip(np.floor(at * FIRST), 0, FIRST - 1)
        active = [
            (Box((cell + 0.5) / FIRST, np.full(at.shape[1], 0.5 / FIRST)), state)
            for cell, state, fine in zip(inside, at, good, strict=True)
            if fine
        ]
        for start in range(0, len(active), _BATCH):
            boxes, states = zip(*active[start : start + _BATCH], strict=True)
            found.boxes += narrowed(self._plans, mode, boxes, np.array(states))
        return found


def narrowed(
    plans: VerificationSubject,
    mode: Mode,
    boxes: Sequence[Box],
    states: Floats,
    *,
    others: Callable[[Box], None] | None = None,
) -> list[Box]:
    """Halve boxes around states until they are proved; return the proved ones.

    Args:
        plans: what is verified.
        mode: mode of the boxes.
        boxes: the boxes.
        states: coordinates of a state in each box, (boxes, coordinates).
        others: receives the other halves, and boxes that stay open, so that all of them together are the
            given boxes. If it is given, proved boxes lie within the conditions of `where`.
    """
    coordinates = len(mode.coordinates)
    axes = max(1, coordinates // 4)
    active = list(boxes)
    index = plans.choices(plans.states(mode, states)).argmax(1)
    proved: list[Box] = []
    for _ in range(HALVINGS * coordinates // axes):
        verdicts = plans.bound(mode, active, index)
        left: list[int] = []
        for i, box in enumerate(active):
            effects = verdicts.effects[i]
            if verdicts.low[i] >= -PROVED:
                known = box if box.inside or others is None else plans.within(mode, box)
                if isinstance(known, Box):
                    proved.append(known)
                    continue
                effects = known
            for axis in np.argsort(-effects)[:axes]:  # halve the box in the coordinates that matter most
                low, high = box.split(int(axis))
                box, other = (high, low) if states[i, axis] >= box.centre[axis] else (low, high)
                if others is not None:
                    others(other)
            active[i] = box
            left.append(i)
        if not left:
            return proved
        active, states, index = [active[i] for i in left], states[left], index[left]
    if others is not None:
        for box in active:
            others(box)
    return proved
