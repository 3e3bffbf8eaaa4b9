"""Fresh initial states, drawn in blocks: one draw of thousands costs little more than one of hundreds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.task import Task

BLOCK = 8192


class Supply:
    """Hands out states that were never handed out before.

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
