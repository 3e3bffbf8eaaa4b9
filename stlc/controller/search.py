"""Repairing plans: batched hill climbing on the exact robustness, from the policy's own plan.

Gradients see nothing from outside a stop zone or across an obstacle; a search does. Each generation tries a
batch of changed plans per state and keeps the best. Changes are noise over a random stretch of time, a
constant shift of a stretch, a stretch held at one random level, and plans that solved other states. The
native kernel does it where there is one, torch elsewhere.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.emit_c import LANES
from stlc.controller.config import cores
from stlc.controller.kernel import Effort
from stlc.controller.task import FLOAT32_SLACK

if TYPE_CHECKING:
    from collections.abc import Callable

    from stlc.controller.task import Task

THOROUGH = 4000
"""Plans that are tried per state at most, unless told otherwise."""
TRIES = 64
"""Plans of a generation where torch does the work."""


@dataclass(frozen=True, slots=True)
class Repaired:
    """What a search found.

    Attributes:
        states: where plans start, (B, n).
        plans: the best plan per state, (B, T, m).
        rho: its exact robustness, (B,).
    """

    states: Tensor
    plans: Tensor
    rho: Tensor

    @property
    def solved(self) -> Tensor:
        """Where the plan satisfies the specification with a little to spare, (B,)."""
        return self.rho >= FLOAT32_SLACK

    def to(self, device: torch.device) -> Repaired:
        """The same on another device."""
        return Repaired(self.states.to(device), self.plans.to(device), self.rho.to(device))


class Searcher:
    """A hill climber over open-loop plans of one task."""

    def __init__(
        self,
        task: Task,
        generator: torch.Generator,
        *,
        enough: float,
        device: torch.device | str = "cpu",
    ) -> None:
        """Search plans of `task`; a state is left alone once its robustness reaches `enough`.

        The generator is of the processor, and so is the native search; states and plans are on `device`.
        """
        self.task = task
        self.generator = generator
        self.enough = enough
        self.low = task.system.control_low.to(device)
        self.high = task.system.control_high.to(device)
        self._aside = ThreadPoolExecutor(1, thread_name_prefix="search")

    def repair(self, x0: Tensor, plans: Tensor, bank: Tensor, *, tries: int = THOROUGH) -> Repaired:
        """Improve plans until they satisfy the specification or the effort is spent.

        Args:
            x0: states, (B, n).
            plans: where to start, (B, T, m).
            bank: plans that solved other states, (k, T, m); may be empty.
            tries: plans per state at most.
        """
        return self.begin(x0, plans, bank, tries=tries, threads=cores()).result().to(x0.device)

    @torch.no_grad()
    def begin(
        self, x0: Tensor, plans: Tensor, bank: Tensor, *, tries: int = THOROUGH, threads: int | None = None
    ) -> Future[Repaired]:
        """`repair` beside whatever else goes on; what it gives depends on arguments and generator alone.

        The native kernel leaves what it found on the processor.
        """
        if self.task.native is not None:
            return self._aside.submit(self._climbing(x0, plans, bank, tries, threads or idle_cores()))
        done: Future[Repaired] = Future()
        done.set_result(self._climb(x0, plans, bank, tries))
        return done

    @torch.no_grad()
    def at_once(self, x0: Tensor, plans: Tensor, *, tries: int) -> Repaired:
        """`repair` without a bank on the caller's own thread, as many threads of the kernel as torch has."""
        bank = plans.new_zeros(0, *plans.shape[1:])
        if self.task.native is None:
            return self._climb(x0, plans, bank, tries)
        return self._climbing(x0, plans, bank, tries, torch.get_num_threads())()

    def _climbing(
        self, x0: Tensor, plans: Tensor, bank: Tensor, tries: int, threads: int
    ) -> Callable[[], Repaired]:
        """A native climb that is ready to go; it has its own copies and its own random numbers."""
        native = self.task.native
        assert native is not None
        seed = int(torch.randint(2**62, (), generator=self.generator))
        x0, plans, bank = (part.to("cpu", copy=True) for part in (x0, plans, bank))
        effort = Effort(-(-tries // LANES), self.enough, seed, threads)

        def climb() -> Repaired:
            best, _ = native.climb(x0, plans, bank, effort)
            rho = self.task.judge(x0, best, states=False).rho
            return Repaired(x0, best, rho)

        return climb

    def _climb(self, x0: Tensor, plans: Tensor, bank: Tensor, tries: int) -> Repaired:
        """The same in torch."""
        found = Repaired(x0, plans.clone(), self.task.judge(x0, plans, states=False).rho.clone())
        for _ in range(-(-tries // TRIES)):
            still = (found.rho < self.enough).nonzero()[:, 0]
            if still.numel() == 0:
                break
            self._keep_better(found, still, self._proposals(found.plans[still], TRIES, bank))
        return found

    def _keep_better(self, found: Repaired, still: Tensor, tried: Tensor) -> None:
        """Judge plans (k, tries, T, m) for the states `still`, (k,), and update `found` in place."""
        tries = tried.shape[1]
        x0 = found.states[still].repeat_interleave(tries, 0)
        judged = self.task.judge(x0, tried.flatten(0, 1), states=False)
        value, which = judged.rho.view(-1, tries).max(1)
        better = (value > found.rho[still]).nonzero()[:, 0]
        rows = still[better]
        found.plans[rows] = tried[better, which[better]]
        found.rho[rows] = value[better]

    def _proposals(self, plans: Tensor, tries: int, bank: Tensor) -> Tensor:
        """Changed plans, (B, tries, T, m), within the bounds."""
        quarter = tries // 4
        span = self.high - self.low
        start = plans[:, None]
        shape = (plans.shape[0], quarter, *plans.shape[1:])
        size = span * 0.5 * torch.exp(-3.0 * self._rand(*shape[:2], 1, 1))
        noise = start + size * self._stretch(shape) * self._randn(*shape)
        shift = start + size * self._stretch(shape) * self._randn(*shape[:2], 1, shape[3])
        level = self.low + span * self._rand(*shape[:2], 1, shape[3])
        held = torch.where(self._stretch(shape) > 0, level, start)
        others = self._others(plans, tries - 3 * quarter, bank)
        return torch.cat((noise, shift, held, others), 1).clamp(self.low, self.high)

    def _others(self, plans: Tensor, count: int, bank: Tensor) -> Tensor:
        """Plans that solved other states; piecewise constant ones while there are few."""
        states, steps, controls = plans.shape
        if bank.shape[0] >= 64:
            return bank[self._randint(0, bank.shape[0], states, count)]
        pieces = 4
        levels = self.low + (self.high - self.low) * self._rand(states, count, pieces, controls)
        return levels.repeat_interleave(-(-steps // pieces), 2)[:, :, :steps]

    def _stretch(self, shape: tuple[int, ...]) -> Tensor:
        """1 on a random stretch of time per plan and control, else 0; (B, tries, T, m)."""
        states, tries, steps, controls = shape
        first = self._randint(0, steps, states, tries, 1, controls)
        length = self._randint(1, steps + 1, states, tries, 1, controls)
        time = torch.arange(steps, device=self.low.device)[None, None, :, None]
        return ((time >= first) & (time < first + length)).to(self.low.dtype)

    def _rand(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator).to(self.low.device)

    def _randn(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator).to(self.low.device)

    def _randint(self, low: int, high: int, *shape: int) -> Tensor:
        return torch.randint(low, high, shape, generator=self.generator).to(self.low.device)


def idle_cores() -> int:
    """Cores that torch leaves to a search beside it, at least one."""
    return max(1, cores() - int(torch.get_num_threads()))
