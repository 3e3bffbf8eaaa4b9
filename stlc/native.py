"""Native kernels: C text compiled by the system's compiler on first use, cached and loaded.

Without a working compiler there is no kernel, and the caller uses its fallback. The name of a cached library
holds a hash of its inputs (text, compiler, its version, flags, processor) and of its content; a library whose
hash does not match is not loaded.
"""

from __future__ import annotations

import ctypes
import hashlib
import platform
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from threading import Lock
from time import perf_counter
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from stlc import cache
from stlc.cache import Cache
from stlc.diagnostics import Diagnostic, notice
from stlc.stopping import leaving
from stlc.toolchain import (
    LONG_REMEMBERED,
    CompilerError,
    TooMuchError,
    compiled,
    compiler,
    failure,
    remember,
    trouble,
    version,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

FLAGS = ("-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC", "-std=c11")
VECTOR_FLAGS = ("-DVECTOR_MATH", *(f"-fno-builtin-{name}" for name in ("sin", "cos", "exp", "log")))
"""Flags for the vector functions of the GNU C library: sine and cosine are not merged into one call."""
LONG = 80_000
"""Characters of a C text from which on `-O3` takes too long for its gain."""
GRAIN = 16
"""Rows that a kernel evaluates together (SIMD lanes)."""
SMALL = 512
"""Rows below which a second thread costs more than it saves."""
PART = 0.05
"""Seconds between checks of the stop flag within a kernel."""

Stop: TypeAlias = Callable[[], bool]


def never() -> bool:
    """A stop condition that never holds."""
    return False


Doubles = "NDArray[np.float64]"


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Parameters of a local search in native code; all arrays are contiguous float64.

    Attributes:
        bounds: lowest and highest value of each control, and 1 for a periodic angle, (3, m).
        factors: scale of each requirement's robustness in the total, (R,).
        bank: library of plans that solved other states, (k, T, m).
        generations: number of generations, in each of which `LANES` changed plans are tried.
        enough: target robustness at which the search of a row (one initial state) ends.
        seed: seed of the random changes.
        stop: condition that ends the search before all rows are done.
    """

    bounds: NDArray[np.float64]
    factors: NDArray[np.float64]
    bank: NDArray[np.float64]
    generations: int
    enough: float
    seed: int
    stop: Stop = never


class Kernel:
    """Library with the compiled functions `judge` (robustness of plans) and `climb` (local search).

    Their C code comes from `stlc.compile.backends.c.emit`.
    """

    def __init__(self, library: ctypes.CDLL, *, states: int, rules: int, steps: int) -> None:
        self._judge, self._climb = library.judge, library.climb
        self._judge.argtypes = [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 4
        self._climb.argtypes = [
            *([ctypes.c_int64] * 2 + [ctypes.c_void_p] * 6),
            *(ctypes.c_int64, ctypes.c_int, ctypes.c_double, ctypes.c_uint64),
        ]
        self._states, self._rules, self._steps = states, rules, steps

    def judge(
        self, x0: NDArray[np.float64], u: NDArray[np.float64], *, threads: int = 1, columns: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Roll out plans with the exact dynamics and compute their robustness.

        Args:
            x0: (B, n), contiguous float64.
            u: (B, T, m), contiguous float64.
            threads: number of threads.
            columns: whether the states are returned too.

        Returns:
            Robustness per requirement (B, R), and the states (n, T+1, B) or None.

        Raises:
            MemoryError: there is not enough memory.
        """
        x0, u = np.ascontiguousarray(x0, dtype=np.float64), np.ascontiguousarray(u, dtype=np.float64)
        batch = len(x0)
        rho = np.empty((batch, self._rules))
        seen = np.empty((self._states, self._steps + 1, batch)) if columns else None
        where = None if seen is None else seen.ctypes.data

        def rows(first: int, last: int) -> int:
            done: int = self._judge(batch, first, last, x0.ctypes.data, u.ctypes.data, rho.ctypes.data, where)
            return done

        _share(rows, batch, 1 if batch < SMALL else threads)
        return rho, seen

    def climb(
        self, x0: NDArray[np.float64], plans: NDArray[np.float64], search: SearchOptions, *, threads: int = 1
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Improve plans by batched local search on the exact robustness.

        Args:
            x0: (B, n), contiguous float64.
            plans: initial guesses, (B, T, m).
            search: parameters of the search.
            threads: number of threads; the result does not depend on it.

        Returns:
            Plans (B, T, m) and their robustness (B,); -inf if the dynamics give NaN. If the search was
            stopped early, the plans of the last rows are unchanged, and their robustness is NaN.

        Raises:
            MemoryError: there is not enough memory.
        """
        x0, plans = np.ascontiguousarray(x0, dtype=np.float64), np.array(plans, dtype=np.float64, order="C")
        rho = np.full(len(x0), np.nan)
        arrays = [a.ctypes.data for a in (x0, plans, rho, search.bounds, search.factors, search.bank)]
        scalars = (len(search.bank), search.generations, search.enough, search.seed)

        def rows(first: int, last: int) -> int:
            done: int = self._climb(first, last, *arrays, *scalars)
            return done

        _share(rows, len(x0), threads, grain=1, stop=search.stop)
        return plans, rho


@dataclass(frozen=True, slots=True)
class ObjectiveSlopes:
    """Derivatives of an objective by robustness and states.

    Attributes:
        by_rho: derivative by the robustness of each requirement, (B, R).
        by_columns: derivative by the states, (n, T+1, B); None if the objective does not depend on states.
        slope: slope of smoothed conditions, per unit.
    """

    by_rho: NDArray[np.float64]
    by_columns: NDArray[np.float64] | None
    slope: float


class Adjoint:
    """Library with the compiled function `pull`, the gradient of an objective by the plans.

    Its C code comes from `stlc.compile.backends.c.adjoint`.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        self._pull = library.pull
        self._pull.argtypes = [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 5 + [ctypes.c_double]

    def pull(
        self,
        x0: NDArray[np.float64],
        u: NDArray[np.float64],
        outcome: ObjectiveSlopes,
        *,
        threads: int = 1,
    ) -> NDArray[np.float64]:
        """Gradient, by the plans, of an objective that depends on robustness and states.

        Args:
            x0: initial states, (B, n).
            u: plans, (B, T, m).
            outcome: derivatives of the objective by robustness and states.
            threads: number of threads.

        Returns:
            The gradient, (B, T, m).

        Raises:
            MemoryError: there is not enough memory.
        """
        arrays = [np.ascontiguousarray(a, dtype=np.float64) for a in (x0, u, outcome.by_rho)]
        columns = None if outcome.by_columns is None else np.ascontiguousarray(outcome.by_columns, np.float64)
        where = None if columns is None else columns.ctypes.data
        batch, out = len(x0), np.empty_like(arrays[1])

        def rows(first: int, last: int) -> int:
            pointers = [a.ctypes.data for a in arrays]
            done: int = self._pull(batch, first, last, *pointers, where, out.ctypes.data, outcome.slope)
            return done

        _share(rows, batch, 1 if batch < SMALL else threads)
        return out


class Advance:
    """Library with the compiled functions `advance` (one step) and `look` (observations).

    Their C code comes from `stlc.compile.backends.c.advance`.

    Args:
        library: library that contains the two functions.
        seen: number of values that the policy reads, k.
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
        self._advance.restype = self._look.restype = None
        self._seen, self._rewarded = seen, rewarded

    def advance(
        self, x: NDArray[np.float64], u: NDArray[np.float64], share: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64] | None]:
        """Advance states by one step of the exact dynamics.

        Args:
            x: states, (B, n), contiguous.
            u: controls, (B, m), contiguous.
            share: last value of every observation.

        Returns:
            The states after the step (B, n), their observations (B, k + 1), and the rewards (B,) or None.
        """
        after = np.empty_like(x)
        seen = np.empty((len(x), self._seen + 1), dtype=np.float32)
        reward = np.empty(len(x)) if self._rewarded else None
        where = None if reward is None else reward.ctypes.data
        self._advance(len(x), x.ctypes.data, u.ctypes.data, share, after.ctypes.data, seen.ctypes.data, where)
        return after, seen, reward

    def look(self, x: NDArray[np.float64], share: float) -> NDArray[np.float32]:
        """Observations of states, (B, n) contiguous -> (B, k + 1), with `share` as the last value."""
        seen = np.empty((len(x), self._seen + 1), dtype=np.float32)
        self._look(len(x), x.ctypes.data, share, seen.ctypes.data)
        return seen


def _share(
    rows: Callable[[int, int], int], batch: int, threads: int, *, grain: int = GRAIN, stop: Stop = never
) -> None:
    """Call `rows(first, last)` on short parts of a batch, on several threads.

    Python code runs between two parts: there, an interruption or `stop` ends the work, and the remaining rows
    are not processed.

    Raises:
        MemoryError: a part returned a value other than 0.
    """
    queue = _Parts(batch, grain, stop)
    if threads < 2:
        queue.work(rows)
    else:
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
    """Division of a batch into parts of about `PART` seconds each, whose sizes are multiples of `grain`."""

    def __init__(self, batch: int, grain: int, stop: Stop) -> None:
        self.failed = False
        self._batch, self._grain, self._next, self._stop = batch, grain, 0, stop
        self._lock = Lock()

    def end(self) -> None:
        """Hand out no more parts."""
        self._next = self._batch

    def work(self, rows: Callable[[int, int], int]) -> None:
        """Process parts until none are left; the size of the next follows from the time of the last."""
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


def load(text: str) -> ctypes.CDLL | None:
    """Library compiled from a C text, or loaded from the cache; None if that fails."""
    using = compiler()
    if using is None:
        return None
    try:
        return _loaded(text, using)
    except CompilerError as error:
        message = f"the C compiler `{using}` {error.why}; the same is done without it, slower"
        notice(Diagnostic("W702", message, help=("`stlc doctor` tries it again",)))
        return None


def why_none(text: str) -> str:
    """Reason for which `load` returned None for a text, as a clause after "because"."""
    using = compiler()
    if using is None:
        return "there is no C compiler"
    try:
        why = trouble(_key(text, using))
    except CompilerError as error:
        why = error.why
    return f"the C compiler {why or 'fails'}"


def _loaded(text: str, using: str) -> ctypes.CDLL | None:
    """Library of a C text for the compiler `using`, from the cache or newly built.

    Raises:
        CompilerError: the compiler cannot be used.
    """
    key = _key(text, using)
    store = cache.persistent()
    places = [place for place in (store, _temporary.get("here")) if place is not None]
    for place in places:
        library = _cached(place, key)
        if library is not None:
            return library
    why = trouble(key)
    if why:
        raise CompilerError(why)
    data = _built(text, using, key)
    if data is None:
        return None
    name = f"kernel-{key}-{hashlib.sha256(data).hexdigest()[:32]}.so"
    if store is None:
        why = cache.why_not()
    elif not store.write(name, data):
        why = f"`{store.shown}` cannot be written to"
    elif (library := _load(store, name)) is not None:
        return library
    else:
        why = f"programs cannot be loaded from `{store.shown}`"
    here = _temporary["here"] = cache.temporary()
    if here is None or not here.write(name, data):
        raise CompilerError("has no folder to write to")
    notice(Diagnostic("W701", f"{why}; kernels in C are built anew in every process"))
    return _load(here, name)


_temporary: dict[str, Cache | None] = {}
"""The temporary folder, created when needed."""


def _key(text: str, using: str) -> str:
    """Hash of all inputs of a build, the name of the library in the cache.

    Raises:
        CompilerError: the compiler cannot be used.
    """
    parts = (text, using, version(using), *FLAGS, *VECTOR_FLAGS, _processor())
    return hashlib.sha256("\0".join(parts).encode(errors="surrogateescape")).hexdigest()[:32]


def _cached(place: Cache, key: str) -> ctypes.CDLL | None:
    """Library with the name `key` in the cache; None if it is missing or its content has changed."""
    for name in place.names(f"kernel-{key}-"):
        data = place.read(name)
        if data is None:
            continue
        if name != f"kernel-{key}-{hashlib.sha256(data).hexdigest()[:32]}.so":
            place.refuse(name, "is not what was written there")
        elif (library := _load(place, name)) is not None:
            return library
    return None


def _load(place: Cache, name: str) -> ctypes.CDLL | None:
    """Load a library; None if the system refuses, such as from a `noexec` disk."""
    try:
        return ctypes.CDLL(str(place.folder / name))
    except OSError:
        return None


def _built(text: str, using: str, key: str) -> bytes | None:
    """Build a library and return its bytes; None if the disk is full.

    Raises:
        CompilerError: the compiler cannot be used.
    """
    try:
        with tempfile.TemporaryDirectory(prefix="stlc-") as folder, leaving(lambda _code: rmtree(folder)):
            source, target = Path(folder) / "kernel.c", Path(folder) / "kernel.so"
            source.write_text(text, encoding="utf-8")
            _compile(using, source, target, key)
            return target.read_bytes()
    except OSError:
        return None


def _compile(using: str, source: Path, target: Path, key: str) -> None:
    """Compile a C text with optimisation, or with less if the compiler exceeds its time or memory limit."""
    try:
        try:
            why = _attempted(using, source, target, "-O3" if source.stat().st_size < LONG else "-O2")
        except TooMuchError:
            why = _attempted(using, source, target, "-O0")
    except TooMuchError as much:
        remember(key, much.why, seconds=LONG_REMEMBERED)
        raise
    if why:
        remember(key, why)
        raise CompilerError(why)


def _attempted(using: str, source: Path, target: Path, level: str) -> str:
    """Compile with vectorised sine and similar functions if the C library has them, else without.

    Returns:
        The reason of a failure, or "".

    Raises:
        CompilerError: the compiler exceeded its limits.
    """
    fast = [[*VECTOR_FLAGS, "-lmvec"]] if sys.platform == "linux" and platform.machine() == "x86_64" else []
    for attempt in (*fast, []):
        done = compiled(using, [level, *FLAGS, str(source), "-o", str(target), *attempt, "-lm"])
        if done.code == 0 and target.is_file():
            return ""
    return failure(done)


def _processor() -> str:
    """Features of the processor, on which `-march=native` depends."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
