"""Random number streams of a world: one shared by its agents, and one for each agent.

An agent's random numbers thus do not depend on the number of other agents.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from stlc.dynamics.model.samplers import seeded

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.dynamics.system import System


@dataclass(frozen=True, slots=True)
class Streams:
    """Generators of one world, derived from the generator that the world receives.

    Attributes:
        shared: generator for draws common to all agents.
        own: one generator per agent.
    """

    shared: torch.Generator
    own: tuple[torch.Generator, ...]

    @classmethod
    def of(cls, generator: torch.Generator, agents: int) -> Streams:
        """Streams for `agents` agents, from a seed that is drawn from `generator`.

        The stream of an agent does not depend on the number of agents.
        """
        base = int(torch.randint(2**62, (), generator=generator))
        made = [seeded(base, key) for key in range(agents + 1)]
        return cls(made[0], tuple(made[1:]))

    def states(self, system: System, count: int = 1) -> Tensor:
        """Initial states from the training distribution, `count` per agent: (agents, count, n) float64."""
        drawn = [system.sample(count, generator=own, dtype=torch.float64) for own in self.own]
        return torch.stack(drawn)
