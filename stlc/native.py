"""C text -> a loaded function: built by the system's compiler on first use, cached by content.

Where there is no compiler, or it fails, there is no kernel and the caller goes on without.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stlc.files import atomic_path

if TYPE_CHECKING:
    from numpy.typing import NDArray

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC", "-std=c11")
SMALL = 512
"""Rows below which a second thread costs more than it saves."""

Doubles = "NDArray[np.float64]"


def cache_folder() -> Path:
    """Where built kernels lie: `$XDG_CACHE_HOME/stlc`, else `~/.cache/stlc`."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "stlc"


def compiler() -> str | None:
    """The system's C compiler: `$CC`, `cc`, `gcc` or `clang`; None where there is none."""
    names = (os.environ.get("CC"), "cc", "gcc", "clang")
    return next((found for name in names if name and (found := shutil.which(name))), None)


class Kernel:
    """A built `judge`; see `stlc.compile.emit_c`."""

    def __init__(self, path: Path, *, states: int, rules: int, steps: int) -> None:
        self._judge = ctypes.CDLL(str(path)).judge
        self._judge.restype = ctypes.c_int
        self._judge.argtypes = [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 4
        self._states, self._rules, self._steps = states, rules, steps

    def judge(
        self, x0: NDArray[np.float64], u: NDArray[np.float64], *, threads: int = 1, columns: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Roll plans out exactly and judge them.

        Args:
            x0: (B, n), contiguous float64.
            u: (B, T, m), contiguous float64.
            threads: to share the rows among.
            columns: whether the states are wanted too.

        Returns:
            Robustness per requirement (B, R), and the states (n, T+1, B) or None.

        Raises:
            MemoryError: there is no room.
        """
        x0, u = np.ascontiguousarray(x0, dtype=np.float64), np.ascontiguousarray(u, dtype=np.float64)
        batch = len(x0)
        rho = np.empty((batch, self._rules))
        seen = np.empty((self._states, self._steps + 1, batch)) if columns else None
        where = None if seen is None else seen.ctypes.data

        def rows(first: int, last: int) -> int:
            done: int = self._judge(batch, first, last, x0.ctypes.data, u.ctypes.data, rho.ctypes.data, where)
            return done

        if threads < 2 or batch < SMALL:
            failed = rows(0, batch)
        else:
            edges = [round(i * batch / threads) for i in range(threads + 1)]
            with ThreadPoolExecutor(threads) as pool:
                failed = any(pool.map(rows, edges[:-1], edges[1:]))
        if failed:
            raise MemoryError
        return rho, seen


def build(text: str) -> Path | None:
    """The shared library of a C text, built if it is not in the cache; None where that cannot be done."""
    using = compiler()
    if using is None:
        return None
    key = hashlib.sha256("\0".join((text, using, *FLAGS, _processor())).encode()).hexdigest()[:32]
    path = cache_folder() / f"kernel-{key}.so"
    if path.exists():
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as beside:
            source = beside.with_suffix(".c")
            source.write_text(text)
            try:
                command = [using, *FLAGS, str(source), "-o", str(beside), "-lm"]
                subprocess.run(command, check=True, capture_output=True, timeout=120)
            finally:
                source.unlink(missing_ok=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return path


def _processor() -> str:
    """What `-march=native` depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
