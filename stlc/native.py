"""Native kernels: C code compiled by the system's compiler on first use, cached, and loaded as a library.

Without a working compiler there is no kernel; results are then computed with NumPy or torch. The name of a
cached library contains two hashes: one of its inputs (C code, compiler, its version, flags, processor), and
one of its content. A library whose content does not match its name is not loaded.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree
from typing import TypeAlias

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
    remember,
    trouble,
    version,
)

FLAGS = ("-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC", "-std=c11")
VECTOR_FLAGS = ("-DVECTOR_MATH", *(f"-fno-builtin-{name}" for name in ("sin", "cos", "exp", "log")))
"""Flags for the vector functions of the GNU C library: sine and cosine are not merged into one call."""
LONG = 80_000
"""Number of characters of C code from which on the option `-O3` takes too much time for what it gains."""
Stop: TypeAlias = Callable[[], bool]


def never() -> bool:
    """Stop condition that is never true."""
    return False


def load(text: str) -> ctypes.CDLL | None:
    """Return the library compiled from C code, built now or loaded from the cache; None if that fails.

    A compiler that cannot be used causes a warning (W702).
    """
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
    """Return the reason why `load` returned None for the C code `text`.

    The reason is a clause that continues a sentence after "because".
    """
    using = compiler()
    if using is None:
        return "there is no C compiler"
    try:
        why = trouble(_key(text, using))
    except CompilerError as error:
        why = error.why
    return f"the C compiler {why or 'fails'}"


def _loaded(text: str, using: str) -> ctypes.CDLL | None:
    """Return the library of the C code `text`, loaded from the cache or built by the compiler `using`.

    The result is None if the disk is full, or if the operating system refuses to load the library.

    Raises:
        CompilerError: the compiler cannot be used, or failed for this code a short while ago.
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
    """Hash of all inputs of a build: C code (`text`), compiler (`using`), its flags, and the processor.

    The hash is a part of the library's file name.

    Raises:
        CompilerError: the compiler cannot be used.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    # the instructions of the processor, which `-march=native` makes use of
    features = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    parts = (text, using, version(using), *FLAGS, *VECTOR_FLAGS, features)
    return hashlib.sha256("\0".join(parts).encode(errors="surrogateescape")).hexdigest()[:32]


def _cached(place: Cache, key: str) -> ctypes.CDLL | None:
    """Load the library with the hash `key` from the cache.

    Return None if there is no such library. A library whose content has changed is removed with a warning.
    """
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
    """Load the library `name` of the cache.

    None is returned if the operating system refuses, as for a disk mounted with `noexec`.
    """
    try:
        return ctypes.CDLL(str(place.folder / name))
    except OSError:
        return None


def _built(text: str, using: str, key: str) -> bytes | None:
    """Compile the C code `text` to a library and return its bytes; None if the disk is full.

    `using` is the compiler. A failure is remembered under `key`.

    Raises:
        CompilerError: the compiler cannot be used, or fails for this code.
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
    """Compile the C file `source` to the library `target` with the compiler `using`.

    It is compiled with optimisation, or without if that exceeds the compiler's time or memory limit. A
    failure is remembered under `key`, so that it is not repeated soon.

    Raises:
        CompilerError: the compiler cannot be used, or fails for this code.
    """
    try:
        try:
            why = _attempted(using, source, target, "-O3" if source.stat().st_size < LONG else "-O2")
        except TooMuchError:
            why = _attempted(using, source, target, "-O0")
    except TooMuchError as much:
        remember(key, much.why, seconds=LONG_REMEMBERED)
        raise
    if why and not source.exists():
        raise CompilerError("was interrupted: a forced exit removed its folder")
    if why:
        remember(key, why)
        raise CompilerError(why)


def _attempted(using: str, source: Path, target: Path, level: str) -> str:
    """Compile the C file `source` to `target` with the option `level` (such as `-O3`).

    Vectorised functions such as sine are used if the system has them.

    Returns:
        The reason if the compiler failed, else "".

    Raises:
        CompilerError: the compiler cannot be used, or exceeded its time or memory limit.
    """
    fast = [[*VECTOR_FLAGS, "-lmvec"]] if sys.platform == "linux" and platform.machine() == "x86_64" else []
    for attempt in (*fast, []):
        done = compiled(using, [level, *FLAGS, str(source), "-o", str(target), *attempt, "-lm"])
        if done.code == 0 and target.is_file():
            return ""
    return done.failure


def cores() -> int:
    """Number of cores that this process may use.

    Processes that `torchrun` started on this machine share the cores evenly.
    """
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, found // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
