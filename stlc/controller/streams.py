"""Randomness of a world: a stream that its agents share, and one of each agent's own.

So what an agent meets does not depend on how many others there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.dynamics.model.system import System


@dataclass(frozen=True, slots=True)
class Streams:
    """Generators of one world, all from the one that it was made with.

    Attributes:
        shared: for what all agents meet.
        own: of each agent.
    """

    shared: torch.Generator
    own: tuple[torch.Generator, ...]

    @classmethod
    def of(cls, generator: torch.Generator, agents: int) -> Streams:
        """Streams for so many agents; the first ones are those of fewer agents."""
        base = int(torch.randint(2**62, (), generator=generator))
        made = [seeded(base, key) for key in range(agents + 1)]
        return cls(made[0], tuple(made[1:]))

    def states(self, system: System, count: int = 1) -> Tensor:
        """Initial states as in training, `count` of each agent's own: (agents, count, n) float64."""
        drawn = [system.sample(count, generator=own, dtype=torch.float64) for own in self.own]
        return torch.stack(drawn)


def seeded(base: int, key: int) -> torch.Generator:
    """A generator that follows from a seed and a number, and shares nothing with those of other numbers."""
    seed = np.random.SeedSequence(base, spawn_key=(key,)).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(seed[0] >> np.uint64(1)))
