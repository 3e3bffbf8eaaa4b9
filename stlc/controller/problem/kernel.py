"""Compiled functions of a task over arrays: verdicts, local search, gradients, and single steps.

Their C code comes from `stlc.compile.backends.c`. Batches are shared out among threads, in parts short enough
that an interruption is noticed between two of them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from stlc.dynamics.system import check_plans
from stlc.native import Stop, never

GRAIN = 16
"""Rows that a kernel evaluates together (SIMD lanes)."""
SMALL = 512
"""Rows below which a second thread costs more than it saves."""
PART = 0.05
"""Seconds between checks of the stop flag within a kernel."""


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Parameters of a local search in native code; all arrays are contiguous float64.

    Attributes:
        bounds: three numbers for each control, (3, m). They are its lowest value, its highest value, and 1 if
            the control is a periodic angle, else 0.
        factors: two numbers for each requirement, (2, R). The first is its weight (tag `@weight`) divided by
            its scale (tag `@scale`); the search multiplies each robustness by this factor, and maximises the
            least product. The second is 1 if the requirement is tagged `@safety`, else 0.
        library: plans that satisfied the specification from other states, (k, T, m). The search may replace
            the last steps of a plan, or all of its steps, by those of a plan in the library.
        generations: largest number of iterations, in each of which several changes of the best plan are
            tried.
        target: robustness at which the search for one initial state ends.
        seed: seed of the random changes.
        cycle: number of iterations after which the comparison of violating plans changes: from the least
            robustness to the sum of the shortfalls of all requirements, and back; 0 if it never does. If it
            does, safe plans are preferred among violating ones.
        stop: function that returns True to end the search before all initial states are done.
    """

    bounds: NDArray[np.float64]
    factors: NDArray[np.float64]
    library: NDArray[np.float64]
    generations: int
    target: float
    seed: int
    cycle: int = 0
    stop: Stop = never


@dataclass(frozen=True, slots=True)
class Sizes:
    """Sizes of the arrays that compiled code reads; it reads beyond the end of smaller ones.

    Attributes:
        states: number n of states.
        controls: number m of controls.
        steps: number T of steps of a plan.
        rules: number R of requirements.
    """

    states: int
    controls: int
    steps: int
    rules: int

    def check(self, x0: NDArray[np.float64], u: NDArray[np.float64]) -> None:
        """Check the shapes of initial states, (B, n), and plans, (B, T, m); ValueError if they are others."""
        shape = {"states": self.states, "controls": self.controls, "steps": self.steps}
        check_plans("the kernel", x0.shape, u.shape, **shape)

    def check_slopes(self, batch: int, outcome: ObjectiveSlopes) -> None:
        """Check the shapes of derivatives, (B, R) and (n, T+1, B); ValueError if they are others."""
        wanted = {"by_rho": (batch, self.rules), "by_columns": (self.states, self.steps + 1, batch)}
        for name, shape in wanted.items():
            given = getattr(outcome, name)
            if given is not None and given.shape != shape:
                raise ValueError(f"`{name}` has the shape {shape}, not {given.shape}")


class Kernel:
    """Loaded library with the compiled functions `judge` (robustness of plans) and `local_search`.

    Its C code comes from `stlc.compile.backends.c.emit`.
    """

    def __init__(self, library: ctypes.CDLL, sizes: Sizes) -> None:
        self._judge, self._search = library.judge, library.local_search
        self._judge.argtypes = [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 4
        self._search.argtypes = [
            *([ctypes.c_int64] * 2 + [ctypes.c_void_p] * 6),
            *(ctypes.c_int64, ctypes.c_int, ctypes.c_double, ctypes.c_uint64, ctypes.c_int),
        ]
        self._sizes = sizes

    def judge(
        self, x0: NDArray[np.float64], u: NDArray[np.float64], *, threads: int = 1, columns: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Roll out plans with the exact dynamics and compute their robustness.

        Args:
            x0: initial states, (B, n).
            u: plans, (B, T, m).
            threads: number of threads.
            columns: whether the states along the plans are returned too.

        Returns:
            Robustness of each requirement, (B, R), and the states, (n, T+1, B), or None without `columns`.

        Raises:
            MemoryError: there is not enough memory.
            ValueError: an array has another shape.
        """
        self._sizes.check(x0, u)
        x0, u = np.ascontiguousarray(x0, dtype=np.float64), np.ascontiguousarray(u, dtype=np.float64)
        batch = len(x0)
        rho = np.empty((batch, self._sizes.rules))
        seen = np.empty((self._sizes.states, self._sizes.steps + 1, batch)) if columns else None
        where = None if seen is None else seen.ctypes.data

        def rows(first: int, last: int) -> int:
            done: int = self._judge(batch, first, last, x0.ctypes.data, u.ctypes.data, rho.ctypes.data, where)
            return done

        _share(rows, batch, 1 if batch < SMALL else threads)
        return rho, seen

    def local_search(
        self, x0: NDArray[np.float64], plans: NDArray[np.float64], search: SearchOptions, *, threads: int = 1
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Improve plans by batched local search on the exact robustness.

        Args:
            x0: initial states, (B, n).
            plans: plans at which the search starts, (B, T, m).
            search: parameters of the search.
            threads: number of threads; the result does not depend on it.

        Returns:
            Improved plans, (B, T, m), and the objective of each, (B,). The objective is the least robustness
            value after multiplication by `search.factors`; it is -inf if a state is NaN. After an early stop,
            plans that were not reached are unchanged, and their objective is NaN.

        Raises:
            MemoryError: there is not enough memory.
            ValueError: an array has another shape.
        """
        self._sizes.check(x0, plans)
        if len(search.library) and search.library.shape[1:] != plans.shape[1:]:
            raise ValueError(f"the library of plans has the shape (k, T, m), not {search.library.shape}")
        x0, plans = np.ascontiguousarray(x0, dtype=np.float64), np.array(plans, dtype=np.float64, order="C")
        rho = np.full(len(x0), np.nan)
        arrays = [a.ctypes.data for a in (x0, plans, rho, search.bounds, search.factors, search.library)]
        scalars = (len(search.library), search.generations, search.target, search.seed, search.cycle)

        def rows(first: int, last: int) -> int:
            done: int = self._search(first, last, *arrays, *scalars)
            return done

        _share(rows, len(x0), threads, grain=1, stop=search.stop)
        return plans, rho


@dataclass(frozen=True, slots=True)
class ObjectiveSlopes:
    """Derivatives of an objective with respect to robustness and states.

    `Adjoint` computes from them the gradient of the objective with respect to the plans.

    Attributes:
        by_rho: derivative with respect to the robustness of each requirement, (B, R).
        by_columns: derivative with respect to the states, (n, T+1, B); None if the objective does not depend
            on states.
        slope: number k, per unit of z. In derivatives, a condition z >= 0 of the dynamics is replaced by the
            smooth step (1 + tanh(k z)) / 2.
    """

    by_rho: NDArray[np.float64]
    by_columns: NDArray[np.float64] | None
    slope: float


class Adjoint:
    """Loaded library with the function `pull`: gradient of an objective with respect to plans.

    Its C code comes from `stlc.compile.backends.c.adjoint`.
    """

    def __init__(self, library: ctypes.CDLL, sizes: Sizes) -> None:
        self._sizes = sizes
        self._pull = library.pull
        self._pull.argtypes = (
            [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 5 + [ctypes.c_double, ctypes.c_void_p]
        )

    def pull(
        self,
        x0: NDArray[np.float64],
        u: NDArray[np.float64],
        outcome: ObjectiveSlopes,
        *,
        threads: int = 1,
    ) -> NDArray[np.float64]:
        """Compute the gradient of an objective with respect to plans.

        The objective is a function of the robustness of the plans and of the states under them.

        Args:
            x0: initial states, (B, n).
            u: plans, (B, T, m).
            outcome: derivatives of the objective with respect to robustness and states.
            threads: number of threads.

        Returns:
            The gradient, (B, T, m).

        Raises:
            MemoryError: there is not enough memory.
            ValueError: an array has another shape.
        """
        return self._pulled(x0, u, outcome, threads)[0]

    def pull_starts(
        self, x0: NDArray[np.float64], u: NDArray[np.float64], outcome: ObjectiveSlopes
    ) -> NDArray[np.float64]:
        """Compute the gradient of an objective with respect to initial states, (B, n); else as `pull`."""
        return self._pulled(x0, u, outcome, 1)[1]

    def _pulled(
        self, x0: NDArray[np.float64], u: NDArray[np.float64], outcome: ObjectiveSlopes, threads: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        self._sizes.check(x0, u)
        self._sizes.check_slopes(len(x0), outcome)
        arrays = [np.ascontiguousarray(a, dtype=np.float64) for a in (x0, u, outcome.by_rho)]
        columns = None if outcome.by_columns is None else np.ascontiguousarray(outcome.by_columns, np.float64)
        where = None if columns is None else columns.ctypes.data
        batch, out, starts = len(x0), np.empty_like(arrays[1]), np.empty_like(arrays[0])

        def rows(first: int, last: int) -> int:
            pointers = [a.ctypes.data for a in arrays]
            done: int = self._pull(
                batch, first, last, *pointers, where, out.ctypes.data, outcome.slope, starts.ctypes.data
            )
            return done

        _share(rows, batch, 1 if batch < SMALL else threads)
        return out, starts


class Advance:
    """Loaded library of one step of a system, observations of a policy, and feedback along trajectories.

    Its C code comes from `stlc.compile.backends.c.advance`.

    Args:
        library: library that contains the functions.
        seen: number k of inputs that the policy computes from a state.
        rewarded: whether the library computes a reward.
    """

    def __init__(self, library: ctypes.CDLL, *, seen: int, rewarded: bool) -> None:
        self._advance, self._look = library.advance, library.look
        pointer = ctypes.c_void_p
        self._advance.argtypes = [
            ctypes.c_int64,
            pointer,
            pointer,
            ctypes.c_double,
            pointer,
            pointer,
            pointer,
        ]
        self._look.argtypes = [ctypes.c_int64, pointer, ctypes.c_double, pointer]
        self._riccati, self._follow = library.riccati, library.follow
        counts = [ctypes.c_int64] * 3
        self._riccati.argtypes = [*counts, *[pointer] * 7]
        self._follow.argtypes = [*counts, *[pointer] * 6, ctypes.c_double, ctypes.c_int64, *[pointer] * 3]
        for function in (self._advance, self._look, self._riccati, self._follow):
            function.restype = None
        self._seen, self._rewarded = seen, rewarded

    def advance(
        self, x: NDArray[np.float64], u: NDArray[np.float64], share: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64] | None]:
        """Advance states by one step of the exact dynamics.

        Args:
            x: states, (B, n), contiguous.
            u: controls, (B, m), contiguous.
            share: elapsed share of the episode, stored as the last value of every observation.

        Returns:
            The states after the step, (B, n), their observations, (B, k + 1), and the rewards, (B,). The
            rewards are None if the library computes none.
        """
        after = np.empty_like(x)
        seen = np.empty((len(x), self._seen + 1), dtype=np.float32)
        reward = np.empty(len(x)) if self._rewarded else None
        where = None if reward is None else reward.ctypes.data
        self._advance(len(x), x.ctypes.data, u.ctypes.data, share, after.ctypes.data, seen.ctypes.data, where)
        return after, seen, reward

    def riccati(self, *problem: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minimise a quadratic cost of linear dynamics; `stlc.controller.search.newton.riccati` in C."""
        by_state, by_control, *cost = (np.ascontiguousarray(part) for part in problem)
        steps, plans, n, m = by_control.shape
        gains = np.empty((steps, plans, m, n + 1))
        pointers = (part.ctypes.data for part in (by_state, by_control, *cost, gains))
        self._riccati(steps, plans, n, *pointers)
        return gains

    def follow(
        self,
        gains: NDArray[np.float64],
        shares: NDArray[np.float64],
        states: NDArray[np.float64],
        *,
        moving: NDArray[np.int64],
        low: NDArray[np.float64],
        span: NDArray[np.float64],
        inside: float,
        lengths: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Change plans by shares of a change, and correct them by feedback along their trajectories.

        Args:
            gains: gains of the feedback and, in the last column, the change, (T, B, m, k + 1), contiguous.
            shares: controls of the plans as shares of their ranges, (B, T, m).
            states: states under them, (B, T + 1, n).
            moving: indices of the k states that the feedback reads, (k,).
            low: least value of each control, (m,).
            span: range of each control, (m,).
            inside: least distance of a control from its bounds, as a share of the distance before.
            lengths: the shares of the change, (L,).

        Returns:
            Controls, (B * L, T, m), as shares of their ranges, and states, (B * L, T + 1, n).
        """
        shares, states = np.ascontiguousarray(shares), np.ascontiguousarray(states)
        batch, steps = shares.shape[:2]
        found = np.empty((batch * len(lengths), *shares.shape[1:]))
        path = np.empty((batch * len(lengths), *states.shape[1:]))
        given = (part.ctypes.data for part in (moving, gains, shares, states, low, span))
        out = (part.ctypes.data for part in (lengths, found, path))
        self._follow(steps, batch, len(moving), *given, inside, len(lengths), *out)
        return found, path

    def look(self, x: NDArray[np.float64], share: float) -> NDArray[np.float32]:
        """Return the observations of contiguous states, (B, n) -> (B, k + 1).

        The last value of an observation is `share`, the elapsed share of the episode.
        """
        seen = np.empty((len(x), self._seen + 1), dtype=np.float32)
        self._look(len(x), x.ctypes.data, share, seen.ctypes.data)
        return seen


def _share(
    rows: Callable[[int, int], int], batch: int, threads: int, *, grain: int = GRAIN, stop: Stop = never
) -> None:
    """Process the rows of a batch in short consecutive ranges, on several threads.

    For each range, `rows(first, last)` is called; the number of rows is a multiple of `grain`. The work ends
    early if the process is interrupted, or if `stop` returns True between two calls. The remaining rows are
    then not processed.

    Raises:
        MemoryError: a call returned a value other than 0.
    """
    queue = _Parts(batch, grain, stop)
    if threads < 2:
        queue.work(rows)
    else:
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor(threads) as pool:
            workers = [pool.submit(queue.work, rows) for _ in range(threads)]
            try:
                for worker in workers:
                    worker.result()
            except BaseException:
                queue.end()
                raise
    if queue.failed:
        raise MemoryError


class _Parts:
    """Queue of the row ranges of a batch, shared by threads; a range takes about `PART` seconds.

    The number of rows of a range is a multiple of `grain`.
    """

    def __init__(self, batch: int, grain: int, stop: Stop) -> None:
        self.failed = False
        self._batch, self._grain, self._next, self._stop = batch, grain, 0, stop
        self._lock = Lock()

    def end(self) -> None:
        """End the work: no further range is processed."""
        self._next = self._batch

    def work(self, rows: Callable[[int, int], int]) -> None:
        """Process ranges of rows until none are left.

        A range takes about `PART` seconds, because the time of each range determines the number of rows of
        the next.
        """
        grains = 1
        while not self.failed:
            with self._lock:
                if self._next < self._batch and self._stop():
                    self._next = self._batch
                first = self._next
                last = self._next = min(first + grains * self._grain, self._batch)
            if first >= last:
                return
            begun = perf_counter()
            self.failed = rows(first, last) != 0 or self.failed
            seconds = max(perf_counter() - begun, 1e-6)
            grains = max(1, min(8 * grains, int(grains * PART / seconds)))
