"""Plan repair by batched local search on the exact robustness, starting from the policy's own plan.

For some requirements, such as stopping in a zone, the gradient of the robustness vanishes outside of the
zone. Gradients also do not lead across an obstacle. A search has neither problem. In every generation, a
batch of changed plans is judged for each state, and the best plan is retained. There are four kinds of
change. Within a random time interval, noise is added, or a constant is added, or the controls are replaced by
a random constant. Or the whole plan is replaced by one that solved another state. The search runs in the
native kernel (compiled code) if there is one, otherwise in torch.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from threading import Event

import torch
from torch import Tensor

from stlc.compile.backends.c.emit import LANES
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.native import Effort
from stlc.controller.problem.rows import Rows
from stlc.controller.problem.task import Task
from stlc.native import Stop, cores, never

CYCLE = 1000
"""Evaluations after which the search for plans of a mission changes the comparison of violating plans.

The least robustness alone hides what a change does to the other requirements, of which a mission has many.
"""
THOROUGH = 4000
"""Default maximum number of evaluations per state."""
TAILS = 8
"""Number of instants of a plan; the remainder after each of them is tried as a further plan."""
TRIES = 64
"""Plans per generation in torch."""
MOST_TRIED = 4_000_000
"""Maximum number of plan entries evaluated at a time in torch, which bounds its memory."""
LOOK = 0.1
"""Interval in seconds at which a waiting thread looks whether it has to stop."""


@dataclass(frozen=True, slots=True)
class SearchResult(Rows):
    """Result of a search.

    Attributes:
        states: initial states, (B, n).
        plans: the best plan found per state, (B, T, m).
        rho: exact robustness of these plans, (B,).
    """

    states: Tensor
    plans: Tensor
    rho: Tensor

    @property
    def solved(self) -> Tensor:
        """Mask of the states whose plan satisfies the specification up to rounding errors, (B,).

        A robustness of exactly 0 counts as satisfied. For example, a requirement may allow a condition to
        fail for 5 steps. From a state that needs all 5 steps, even the best plan has robustness 0.
        """
        return TOLERANCE.satisfied(self.rho)


def remainders(task: Task, found: SearchResult, count: int) -> SearchResult:
    """Plans from `count` states that each plan visits at equal intervals: what remains of it there.

    A plan that ends with a mission satisfies the specification from every state on its way. A remainder is
    extended to T steps by repeating its last control, and left out if it does not satisfy the specification.
    The first of the states is the initial one.
    """
    steps = found.plans.shape[1]
    path = task.rollout(found.states, found.plans)
    begun = torch.arange(0, steps, max(1, -(-steps // count)), device=found.plans.device)
    index = (begun[:, None] + torch.arange(steps, device=begun.device)).clamp(max=steps - 1)
    x0, u = path[:, begun].flatten(0, 1), found.plans[:, index].flatten(0, 1)
    judged = SearchResult(x0, u, task.judge(x0, u, states=False).rho)
    return judged.of(judged.solved)


class Search:
    """A local search that runs concurrently with other work.

    Its result depends on states, plans, seed and plan library alone, not on timing, interruption or restart.
    A search by the native kernel (compiled code) runs on a thread of its own. A search in torch runs inside
    the method `advance`.

    Attributes:
        states: initial states, (B, n).
        plans: initial plans, (B, T, m).
        seed: seed of the search's random numbers.
    """

    def __init__(self, states: Tensor, plans: Tensor, seed: int) -> None:
        self.states, self.plans, self.seed = states, plans, seed
        self._cancelled = Event()
        self._torch: _TorchSearch | None = None
        self._share = 1
        self._found: Future[SearchResult] = Future()

    @classmethod
    def of(cls, found: SearchResult) -> Search:
        """A search that is already finished, with the given result."""
        search = cls(found.states, found.plans, 0)
        search._found.set_result(found)
        return search

    def on_thread(self, pool: ThreadPoolExecutor, search: Callable[[Stop], SearchResult]) -> Search:
        """Start the search function `search` on a thread of `pool`; return this object.

        `search` receives the stop condition of the search.
        """
        self._found = pool.submit(search, self._cancelled.is_set)
        return self

    def by_steps(self, search: _TorchSearch, steps: int) -> Search:
        """Let `search` run in `steps` equal parts, one per call of `advance`; return `self`."""
        self._torch, self._share = search, -(-search.left // max(1, steps))
        return self

    def done(self) -> bool:
        """True once the search has ended."""
        return self._found.done()

    def advance(self) -> None:
        """Do the next part of a search in torch; do nothing for a search that runs on a thread of its own."""
        if self._torch is not None and not self.done():
            for _ in range(self._share):
                if not self._torch.generation():
                    self._found.set_result(self._torch.found)
                    break

    def result(self, stop: Stop = never) -> SearchResult | None:
        """Wait for the result and return it; None if `stop` ended the wait early."""
        while not self.done():
            if stop():
                return None
            if self._torch is not None:
                self.advance()
            else:
                with suppress(TimeoutError):
                    self._found.result(LOOK)
        return self._found.result()

    def cancel(self) -> None:
        """Ask the search on its thread to end early."""
        self._cancelled.set()


class Searcher:
    """Local search over open-loop plans of one task."""

    def __init__(
        self,
        task: Task,
        generator: torch.Generator,
        *,
        target: float,
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepare searches for plans of `task` with the robustness `target`.

        `generator`: source of all random numbers, on the CPU. `device`: torch device of states and plans; a
        search in compiled code runs on the CPU all the same.
        """
        self.task = task
        self.generator = generator
        self.target = target
        self.device = device
        self._aside = ThreadPoolExecutor(1, thread_name_prefix="search")

    @torch.no_grad()
    def repair(
        self,
        x0: Tensor,
        plans: Tensor,
        library: Tensor | None = None,
        *,
        tries: int = THOROUGH,
        stop: Stop = never,
        threads: int = 0,
    ) -> SearchResult:
        """Improve plans until they reach the target robustness, or until `tries` plans per state were judged.

        The target is that of the constructor.

        Args:
            x0: states, (B, n).
            plans: initial plans, (B, T, m).
            library: plans that satisfy the specification from other states, (k, T, m); may be empty.
            tries: maximum number of plans judged per state.
            stop: condition that ends the search early, with the best plans until then.
            threads: number of threads of compiled code; 0 for all cores.
        """
        library = plans[:0] if library is None else library
        if self.task.native is not None:
            search = self._native_search(x0, plans, library, tries, threads or cores(), self._seed())
            return search(stop).to(x0.device)
        return self._torch_search(x0, plans, library, tries, self._seed()).finish(stop)

    @torch.no_grad()
    def begin(
        self,
        x0: Tensor,
        plans: Tensor,
        library: Tensor,
        *,
        tries: int = THOROUGH,
        steps: int = 1,
        seed: int | None = None,
    ) -> Search:
        """Start the search that `repair` describes, concurrently with other work; return it.

        The native kernel runs on a thread of its own and leaves its result on the CPU. In torch, the search
        is divided into `steps` parts; each call of `Search.advance` does one part.
        """
        seed = self._seed() if seed is None else seed
        search = Search(x0, plans, seed)
        if self.task.native is not None:
            return search.on_thread(
                self._aside, self._native_search(x0, plans, library, tries, idle_cores(), seed)
            )
        return search.by_steps(self._torch_search(x0, plans, library, tries, seed), steps)

    def _seed(self) -> int:
        return int(torch.randint(2**62, (), generator=self.generator))

    def _native_search(
        self, x0: Tensor, plans: Tensor, library: Tensor, tries: int, threads: int, seed: int
    ) -> Callable[[Stop], SearchResult]:
        """Prepare a search in compiled code; its inputs are copied.

        Returns:
            Function that runs the search on `threads` threads and returns the result. Its argument is a
            condition that ends the search early.
        """
        native = self.task.native
        assert native is not None
        x0, plans, library = (part.to("cpu", copy=True) for part in (x0, plans, library))

        def search(stop: Stop) -> SearchResult:
            cycle = CYCLE // LANES if self.task.compiled.grid.end is not None else 0
            effort = Effort(-(-tries // LANES), self.target, seed, cycle, threads, stop)
            best, _ = native.local_search(x0, plans, library, effort)
            rho = self.task.judge(x0, best, states=False).rho
            return SearchResult(x0, best, rho)

        return search

    def _torch_search(
        self, x0: Tensor, plans: Tensor, library: Tensor, tries: int, seed: int
    ) -> _TorchSearch:
        rho = self.task.judge(x0, plans, states=False).rho.clone()
        found = SearchResult(x0.clone(), plans.clone(), rho)
        generator = torch.Generator().manual_seed(seed)
        return _TorchSearch(self.task, found, library.clone(), -(-tries // TRIES), self.target, generator)


class _TorchSearch:
    """Local search in torch, by the method of the native kernel; a generation is a batch of changed plans.

    Attributes:
        found: the best plan of each state until now.
        left: maximum number of remaining generations.
    """

    def __init__(
        self,
        task: Task,
        found: SearchResult,
        library: Tensor,
        generations: int,
        target: float,
        generator: torch.Generator,
    ) -> None:
        self.task, self.found, self.library, self.left = task, found, library, generations
        self.target, self.generator = target, generator
        device = found.states.device
        self.low, self.high = task.system.control_low.to(device), task.system.control_high.to(device)

    @torch.no_grad()
    def generation(self, stop: Stop = never) -> bool:
        """Try `TRIES` changed plans for every state whose plan has not reached the target robustness.

        Returns:
            False if no generation is left or all plans have reached the target, else True.
        """
        still = (self.found.rho < self.target).nonzero()[:, 0]
        if self.left == 0 or not len(still):
            return False
        self.left -= 1
        for part in torch.split(still, max(1, MOST_TRIED // (TRIES * self.found.plans[0].numel()))):
            if stop():
                break
            self._keep_better(part, self._proposals(self.found.plans[part], TRIES, self.library))
        return self.left > 0

    def finish(self, stop: Stop = never) -> SearchResult:
        """Run the search to its end and return the result."""
        while not stop() and self.generation(stop):
            pass
        return self.found

    def _keep_better(self, still: Tensor, tried: Tensor) -> None:
        """Judge the plans `tried`, (k, tries, T, m), for the states with indices `still`; update `found`."""
        found, tries = self.found, tried.shape[1]
        x0 = found.states[still].repeat_interleave(tries, 0)
        judged = self.task.judge(x0, tried.flatten(0, 1), states=False)
        value, which = judged.rho.view(-1, tries).max(1)
        better = (value > found.rho[still]).nonzero()[:, 0]
        rows = still[better]
        found.plans[rows] = tried[better, which[better]]
        found.rho[rows] = value[better]

    def _proposals(self, plans: Tensor, tries: int, library: Tensor) -> Tensor:
        """Random plans within the control bounds: (B, T, m) -> (B, tries, T, m).

        Three quarters are changed copies of `plans`. The others are taken from `library`, or are piecewise
        constant if the library holds few plans.
        """
        quarter = tries // 4
        span = self.high - self.low
        start = plans[:, None]
        shape = (plans.shape[0], quarter, *plans.shape[1:])
        size = span * 0.5 * torch.exp(-3.0 * self._rand(*shape[:2], 1, 1))
        noise = start + size * self._stretch(shape) * self._randn(*shape)
        shift = start + size * self._stretch(shape) * self._randn(*shape[:2], 1, shape[3])
        level = self.low + span * self._rand(*shape[:2], 1, shape[3])
        held = torch.where(self._stretch(shape) > 0, level, start)
        count, (states, steps, controls) = tries - 3 * quarter, plans.shape
        if library.shape[0] >= 64:
            others = library[self._randint(0, library.shape[0], states, count)]
        else:
            pieces = 4
            levels = self.low + span * self._rand(states, count, pieces, controls)
            others = levels.repeat_interleave(-(-steps // pieces), 2)[:, :, :steps]
        return torch.cat((noise, shift, held, others), 1).clamp(self.low, self.high)

    def _stretch(self, shape: tuple[int, ...]) -> Tensor:
        """Draw random intervals of time: (B, tries, T, m), 1 inside an interval and 0 outside.

        There is one interval for each of the changed plans and each control.
        """
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
    """Number of cores that torch leaves to a concurrent search, at least 1."""
    return max(1, cores() - int(torch.get_num_threads()))
