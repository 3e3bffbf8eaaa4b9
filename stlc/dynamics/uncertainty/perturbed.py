"""Perturbed systems: true dynamics of several agents, each with its own errors of the uncertain numbers."""

from __future__ import annotations

from torch import Tensor

from stlc.diagnostics import usage
from stlc.dynamics.declaration.perturbable import Perturbable
from stlc.dynamics.model.rollout import Columns
from stlc.dynamics.model.samplers import Drawing, completed
from stlc.dynamics.system import System


class PerturbedSystem(System):
    """True dynamics of several agents, each with its own factors; all agents are stepped in one batch.

    Args:
        factored: dynamics in which every uncertain number is multiplied by a factor.
        factors: values of the factors, (agents, uncertain numbers); 1 for a number without error.
    """

    def __init__(self, factored: Perturbable, factors: Tensor) -> None:
        super().__init__(factored.decl)
        self._factored, self.values = factored, factors
        self._factors = {each.factor: factors[:, index] for index, each in enumerate(factored.numbers)}
        self._started = tuple(map(Drawing, factored.started))

    def of_agents(self, rows: Tensor) -> PerturbedSystem:
        """The true system of the agents `rows`, (k,) int64, alone."""
        return PerturbedSystem(self._factored, self.values[rows])

    def _completed(self, states: Tensor) -> Tensor:
        """Compute columns that follow from the others, such as held values, with the errors of the agents.

        Raises:
            UsageError: U101, they depend on the errors, and there are not as many states as agents.
        """
        if not self._started:
            return states
        if len(states) != len(self.values):
            names = ", ".join(f"`{each.name}`" for each in self._started)
            message = f"{names} at the start depends on the errors of the {len(self.values)} agents"
            ways_out = "draw one state for each agent"
            raise usage(f"{message}, and the world draws {len(states)} states", ways_out)
        return completed(states, self.names, self._started, self._factors)

    def _inputs(self, u: Tensor) -> Columns:
        """Return the controls and the factors of the uncertain numbers as columns by name."""
        return {**super()._inputs(u), **{name: factor.to(u) for name, factor in self._factors.items()}}
