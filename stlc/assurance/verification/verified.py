"""Results of a verification: what is proved and refuted, also around random states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from stlc.assurance.bounds import clopper_pearson_lower
from stlc.assurance.verification.around import Around
from stlc.assurance.verification.verify import ModeResult, Verification
from stlc.jsontext import Num


@dataclass(frozen=True, slots=True)
class VerifiedMode:
    """Proved, refuted and open shares of one mode of the initial states, and boxes around random states."""

    JSON: ClassVar = (
        "name=result.mode.name probability proved=result.proved refuted=result.refuted open=result.open "
        "proved_boxes examined_boxes=result.examined witness robustness states=near.states "
        "states_proved=near.proved states_violated=near.violated"
    )

    result: ModeResult
    probability: Num
    near: Around

    @property
    def proved_boxes(self) -> int:
        """Number of proved boxes."""
        return len(self.result.boxes)

    @property
    def witness(self) -> dict[str, Num] | None:
        """Initial state of the worst counterexample; None if none was found."""
        return None if self.result.witness is None else dict(self.result.witness.state)

    @property
    def robustness(self) -> Num | None:
        """Robustness from that state."""
        return None if self.result.witness is None else self.result.witness.robustness


@dataclass(frozen=True, slots=True)
class Verified:
    """Proved, refuted and open shares of the initial states of a run."""

    JSON: ClassVar = (
        "run seconds=found.seconds proved=found.proved refuted=found.refuted open=found.open states "
        "states_proved states_violated states_share modes"
    )

    run: str
    found: Verification
    near: Sequence[Around]

    @property
    def modes(self) -> list[VerifiedMode]:
        """The modes."""
        pairs = zip(self.found.modes, self.near, strict=True)
        return [VerifiedMode(each, self.found.probability(each), around) for each, around in pairs]

    @property
    def states(self) -> int:
        """Number of random states."""
        return sum(each.states for each in self.near)

    @property
    def states_proved(self) -> int:
        """Number of those in a proved box around them."""
        return sum(each.proved for each in self.near)

    @property
    def states_violated(self) -> int:
        """Number of those from which the policy's plan violates the specification."""
        return sum(each.violated for each in self.near)

    @property
    def states_share(self) -> Num:
        """Share of all initial states with such a box, at least, with 95 % confidence."""
        return clopper_pearson_lower(self.states_proved, self.states) if self.states else 0.0
