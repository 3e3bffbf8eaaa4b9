"""A system whose numbers are not what its model says, for each of its agents in another way."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stlc.dynamics.model.system import System

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.dynamics.model.rollout import Columns
    from stlc.dynamics.scenarios.uncertain import Loose


class Mistaken(System):
    """The truth of some agents; it steps them all at once, in their order.

    Args:
        loose: the dynamics, with a factor at every uncertain number.
        factors: (agents, numbers), 1 where a number is right.
    """

    def __init__(self, loose: Loose, factors: Tensor) -> None:
        super().__init__(loose.decl)
        self._factors = {each.factor: factors[:, index] for index, each in enumerate(loose.numbers)}

    def _inputs(self, u: Tensor) -> Columns:
        """Controls, and how wrong the numbers are."""
        return {**super()._inputs(u), **{name: factor.to(u) for name, factor in self._factors.items()}}
