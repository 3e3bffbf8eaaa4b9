"""Training states: fresh ones, drawn in blocks of thousands, or a fixed set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import torch

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from stlc.controller.problem.task import Task

BLOCK = 8192


class Supply(Protocol):
    """Where training states come from."""

    def take(self, n: int) -> Tensor:
        """The next `n` states, (n, dim), float32."""

    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Take note of plans that solve states which a policy fails on: (k, n), (k, T, m)."""

    def tensors(self) -> dict[str, Tensor]:
        """All that goes on counting, by name."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where `tensors` were taken."""


class Draws:
    """Independent initial states.

    Attributes:
        block: drawn and not yet handed out, (k, n).
    """

    def __init__(self, task: Task, generator: torch.Generator, device: torch.device) -> None:
        self._task = task
        self._generator = generator
        self._device = device
        self.block = torch.empty(0, len(task.names), device=device)

    def take(self, n: int) -> Tensor:
        """`n` fresh states, (n, dim), float32."""
        while self.block.shape[0] < n:
            drawn = self._task.sample(max(n, BLOCK), generator=self._generator, device=self._device)
            self.block = torch.cat((self.block, drawn))
        taken, self.block = self.block[:n], self.block[n:]
        return taken

    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Where a plan leads does not matter to independent draws."""

    def tensors(self) -> dict[str, Tensor]:
        """What was drawn and not yet handed out."""
        return {"block": self.block}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where `tensors` were taken."""
        self.block = tensors["block"].to(self._device)


class Fixed:
    """A training set: states of another supply, handed out in a new order each time it has been used up.

    Attributes:
        states: all of them, (size, n).
        queue: indices of those that are still to come, (k,).
    """

    def __init__(self, fresh: Supply, size: int, generator: torch.Generator) -> None:
        self._generator = generator
        self.states = fresh.take(size)
        self.queue = torch.empty(0, dtype=torch.int64, device=self.states.device)

    def take(self, n: int) -> Tensor:
        """The next `n` states, (n, dim), float32."""
        size = self.states.shape[0]
        while self.queue.shape[0] < n:
            order = torch.randperm(size, generator=self._generator)
            self.queue = torch.cat((self.queue, order.to(self.states.device)))
        taken, self.queue = self.queue[:n], self.queue[n:]
        return self.states[taken]

    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Where a plan leads does not change the set."""

    def tensors(self) -> dict[str, Tensor]:
        """The set, and what of it is still to come."""
        return {"states": self.states, "queue": self.queue}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where `tensors` were taken."""
        self.states, self.queue = (tensors[name].to(self.states.device) for name in ("states", "queue"))
