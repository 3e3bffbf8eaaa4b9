"""Hard examples: states that the policy failed on, with a plan that solves each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

CAPACITY = 20_000


@dataclass(slots=True)
class Buffer:
    """A ring of solved hard states.

    Attributes:
        states: (capacity, n).
        plans: (capacity, T, m).
        count: solved states ever added; the newest `min(count, capacity)` are kept.
    """

    states: Tensor
    plans: Tensor
    count: int = 0

    @classmethod
    def empty(cls, state: int, steps: int, controls: int, device: torch.device) -> Buffer:
        """A buffer without entries for states of `state` columns and plans of `steps` x `controls`."""
        return cls(
            torch.zeros(CAPACITY, state, device=device), torch.zeros(CAPACITY, steps, controls, device=device)
        )

    def __len__(self) -> int:
        return min(self.count, CAPACITY)

    @property
    def bank(self) -> Tensor:
        """Plans of all entries, (len, T, m)."""
        return self.plans[: len(self)]

    def add(self, states: Tensor, plans: Tensor) -> None:
        """Append (k, n) states and (k, T, m) plans, the oldest go first."""
        index = (torch.arange(states.shape[0], device=states.device) + self.count) % CAPACITY
        self.states[index], self.plans[index] = states, plans
        self.count += states.shape[0]

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """`n` entries with replacement: (n, dim), (n, T, m)."""
        index = torch.randint(len(self), (n,), generator=generator).to(self.states.device)
        return self.states[index], self.plans[index]
