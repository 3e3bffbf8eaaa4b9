"""Data-parallel training by several processes (ranks), started by `torchrun`.

Every rank draws its own states, searches on its own, and learns from the mean of all gradients, so that all
ranks have the same weights. Decisions that must be equal on all ranks (steps, margin, when to save, when to
stop) are made by collective operations. Only the first rank writes the run. gloo communicates tensors on
CPUs, nccl those on GPUs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as dist
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from stlc.diagnostics import MissingError

PATIENCE = timedelta(minutes=10)
"""Timeout of collective operations; building a kernel takes a minute at most."""
_SPREAD = 0x9E3779B97F4A7C15
"""Seed offset between ranks: 2^64 over the golden ratio (D. Knuth, The Art of Computer Programming 6.4)."""

KINDS = ("cpu", "cuda", "mps", "xpu")
"""Kinds of torch devices on which a policy can be trained."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Ranks:
    """One of the processes (ranks) of a distributed training run, and its communication with the others.

    The methods that communicate (`learn`, `mean`, `any`, `gather`, and those that begin with `agree`) are
    collective: all ranks must call them at the same time. If there is only one process, nothing is sent.

    Attributes:
        rank: index of this process, from 0.
        size: number of processes.
        local: index of this process on its machine.
    """

    rank: int = 0
    size: int = 1
    local: int = 0

    @property
    def first(self) -> bool:
        """True for the rank that prints and writes."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """Seed for the states and searches of this rank; for the first rank, the run's seed `seed` itself."""
        return (seed + self.rank * _SPREAD) % 2**63

    def device(self, name: str) -> str:
        """Torch device of this rank; if several ranks use `cuda`, each has a GPU of its own."""
        return f"cuda:{self.local}" if name == "cuda" and self.size > 1 else name

    def learn(self, weights: Iterable[nn.Parameter], value: Tensor) -> Tensor:
        """Replace the gradients of `weights`, in place, by their means over the ranks (all-reduce).

        Returns:
            The mean of `value` over the ranks, ().
        """
        if self.size == 1:
            return value
        slopes = [weight.grad for weight in weights if weight.grad is not None]
        flat = torch.cat([value.detach().view(1), *(slope.reshape(-1) for slope in slopes)])
        self._together(lambda: dist.all_reduce(flat))
        mean, *parts = torch.split(flat / self.size, [1, *(slope.numel() for slope in slopes)])
        for slope, part in zip(slopes, parts, strict=True):
            slope.copy_(part.view_as(slope))
        return mean.view(())

    def mean(self, values: Sequence[float]) -> list[float]:
        """Mean of each number over the ranks; all ranks must pass equally many numbers."""
        return [total / self.size for total in self._reduced(values, dist.ReduceOp.SUM)]

    def any(self, flag: bool) -> bool:
        """True on every rank if `flag` is True on at least one rank."""
        return self._reduced([flag], dist.ReduceOp.MAX)[0] > 0.0

    def agree(self, value: float) -> float:
        """Broadcast the number `value` of the first rank, and return it on every rank."""
        return self._reduced([value if self.first else 0.0], dist.ReduceOp.SUM)[0]

    def agree_on(self, module: nn.Module) -> None:
        """Broadcast the weights of the first rank's module; those of the other ranks are overwritten."""
        if self.size > 1:
            for part in module.state_dict().values():
                self._together(lambda part=part: dist.broadcast(part, 0))  # type: ignore[misc]

    def agree_text(self, text: str) -> str:
        """Broadcast `text` of the first rank, and return it on every rank."""
        if self.size == 1:
            return text
        data = torch.tensor(list(text.encode()), dtype=torch.uint8)
        size = int(self.agree(len(data)))
        sent = data if self.first else torch.empty(size, dtype=torch.uint8)
        self._together(lambda: dist.broadcast(sent, 0))
        return bytes(sent.tolist()).decode()

    def gather(self, tensors: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
        """Send the tensors of the other ranks to the first one.

        Returns:
            On the first rank, the tensors of ranks 1, 2, …; on any other rank, an empty list.
        """
        if self.first:
            return [self._received(rank) for rank in range(1, self.size)]
        data = save_tensors({name: part.detach().cpu().contiguous() for name, part in tensors.items()})
        sent = torch.frombuffer(bytearray(data), dtype=torch.uint8)
        self._together(lambda: dist.send(torch.tensor([len(sent)]), 0))
        self._together(lambda: dist.send(sent, 0))
        return []

    def _received(self, rank: int) -> dict[str, Tensor]:
        size = torch.zeros(1, dtype=torch.int64)
        self._together(lambda: dist.recv(size, rank))
        data = torch.empty(int(size), dtype=torch.uint8)
        self._together(lambda: dist.recv(data, rank))
        found: dict[str, Tensor] = load_tensors(data.numpy().tobytes())
        return found

    def _reduced(self, values: Sequence[float], how: dist.ReduceOp.RedOpType) -> list[float]:
        if self.size == 1:
            return list(values)
        together = torch.tensor([float(value) for value in values], dtype=torch.float64)
        self._together(lambda: dist.all_reduce(together, how))
        found: list[float] = together.tolist()
        return found

    def _together(self, talk: Callable[[], T]) -> T:
        """Run the collective operation `talk` and return its result.

        Raises:
            MissingError: R403, another rank cannot be reached any more.
        """
        try:
            return talk()
        except RuntimeError as error:
            raise _lost(self, error) from error


ALONE = Ranks()


def expected() -> Ranks:
    """The rank of this process according to the environment variables of `torchrun`."""
    rank, size, local = (int(os.environ.get(name, 0)) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"))
    return Ranks(rank, size, local) if size > 1 else ALONE


def find_device(name: str) -> torch.device:
    """Return the torch device `name`; `auto` is the GPU if there is one, else the CPU.

    Raises:
        MissingError: R302, the device does not exist.
    """
    try:
        best = "cuda" if torch.cuda.is_available() else "cpu"
        device = torch.device(best if name == "auto" else name)
        if device.type not in KINDS:
            raise RuntimeError(f"the kind `{device.type}` is none of {', '.join(KINDS)}")
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].partition(". ")[0]
        raise MissingError.of(
            "R302", f"there is no device `{name}` here", help=("use --device cpu",), note=(reason,)
        ) from error
    return device


@contextmanager
def joined(device: str) -> Iterator[Ranks]:
    """Context in which the ranks (processes) of this training are connected; yields this process's `Ranks`.

    Args:
        device: torch device; on `cuda` every rank of a machine takes a GPU of its own.

    Raises:
        MissingError: R302, the device does not exist; R403, another rank cannot be reached.
    """
    ranks = expected()
    if ranks.size == 1:
        yield ranks
        return
    own = ranks.device(device)
    gpu = find_device(own).type == "cuda"
    try:
        if gpu:
            torch.cuda.set_device(own)
        dist.init_process_group("cpu:gloo,cuda:nccl" if gpu else "gloo", timeout=PATIENCE)
    except (RuntimeError, ValueError, AssertionError) as error:
        raise _lost(ranks, error) from error
    try:
        yield ranks
    finally:
        dist.destroy_process_group()


def _lost(ranks: Ranks, error: Exception) -> MissingError:
    reason = (str(error).strip() or type(error).__name__).splitlines()[0].partition(". ")[0]
    return MissingError.of(
        "R403",
        f"a process of this training is gone (rank {ranks.rank} of {ranks.size} noticed)",
        help=(
            "see what ended it above, or in the log of its machine; memory and time limits often do",
            f"torchrun --nproc-per-node {ranks.size} -m stlc train --resume RUN goes on from"
            " the last checkpoint",
        ),
        note=(reason,),
    )
