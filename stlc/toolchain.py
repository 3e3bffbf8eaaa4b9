"""The system's C compiler: search, version, and execution under resource limits.

A compiler that hangs, or takes too much time or memory, is killed with its child processes. A compiler that
hung is not started again by this process, nor for `REMEMBERED` seconds by other processes of the user.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from stlc import cache
from stlc.cache import Cache
from stlc.stopping import leaving

IDLE = 10.0
"""Seconds without processor use after which a program counts as hung."""
BUSY = 40.0
"""Limit of a program's processor time in seconds; if that is unknown, of its elapsed time."""
ELAPSED = 300.0
"""Limit of a program's elapsed time in seconds, however busy the machine is."""
MEMORY = 2_000_000_000
"""Limit of a program's memory in bytes, if its use is known."""
REMEMBERED = 600.0
"""Seconds for which other processes do not start a hung compiler again."""
LONG_REMEMBERED = 86_400.0
"""Seconds for which other processes do not compile again a text that exceeded the limits."""
_GRACE = 0.5
"""Seconds from SIGTERM to SIGKILL."""
_PROBE = "#include <math.h>\nint works(void) { return 1; }\n"


class CompilerError(Exception):
    """Error: the compiler cannot be used; `why` is the reason, printed after the compiler's name."""

    def __init__(self, why: str) -> None:
        super().__init__(why)
        self.why = why


class TooMuchError(CompilerError):
    """Error: the compiler exceeds its time or memory limit for a C source."""


class HangsError(Exception):
    """Error: a program was ended because it hung or exceeded a limit.

    Attributes:
        why: reason in words.
        worked: True if the program exceeded its limit of processor time or memory. False if the program hung,
            that is, used no processor time for too long.
    """

    def __init__(self, why: str, *, worked: bool = False) -> None:
        super().__init__(why)
        self.why = why
        self.worked = worked


@dataclass(frozen=True, slots=True)
class ProgramResult:
    """Result of a program that ended: exit code, standard output (`out`), standard error (`errors`)."""

    code: int
    out: str
    errors: str

    @property
    def failure(self) -> str:
        """Reason for a compiler's failure in one line: its exit code and first error message."""
        lines = [line.strip() for line in (self.errors or self.out).splitlines() if line.strip()]
        message = next((line for line in lines if "error" in line.lower()), lines[0] if lines else "")
        return f"fails with exit code {self.code}" + (f": {message[:160]}" if message else "")


def compiler() -> str | None:
    """Path of the system's C compiler: `$CC`, `cc`, `gcc` or `clang`; None if there is none."""
    names = (os.environ.get("CC"), "cc", "gcc", "clang")
    return next((found for name in names if name and (found := shutil.which(name))), None)


def compiled(using: str, arguments: Sequence[str]) -> ProgramResult:
    """Run the compiler `using` with arguments and return its result, also if it fails.

    Raises:
        TooMuchError: the compiler exceeded its time or memory limit.
        CompilerError: the compiler hangs, did so a short while ago, or cannot be started.
    """
    key = _identity(using)
    why = trouble(key)
    if why:
        raise CompilerError(why)
    try:
        return run([using, *arguments])
    except HangsError as hangs:
        if hangs.worked:
            raise TooMuchError(hangs.why) from hangs
        remember(key, hangs.why)
        raise CompilerError(hangs.why) from hangs
    except OSError as error:
        raise CompilerError(f"cannot be started: {(error.strerror or str(error)).lower()}") from error


_versions: dict[str, str] = {}


def version(using: str) -> str:
    """Text that identifies a compiler: a hash of its path and file status, and its output for `--version`.

    Raises:
        CompilerError: the compiler cannot be used.
    """
    key = _identity(using)
    why = trouble(key)
    if why:
        raise CompilerError(why)
    if key not in _versions:
        _versions[key] = compiled(using, ["--version"]).out
    return f"{key}\0{_versions[key]}"


def _identity(using: str) -> str:
    """Key under which failures of the compiler `using` are stored.

    It is a hash of the path, the size and the modification time of its file.
    """
    try:
        found = Path(using).stat()
        facts = f"{using} {found.st_size} {found.st_mtime_ns} {found.st_ino}"
    except OSError:
        facts = using
    return sha256(facts.encode(errors="surrogateescape")).hexdigest()[:32]


def works(using: str) -> str:
    """Test whether the compiler `using` can build a library; remembered failures are forgotten first.

    Returns:
        The reason if the compiler cannot, else "".
    """
    forget()
    try:
        version(using)
        with tempfile.TemporaryDirectory(prefix="stlc-") as folder:
            source = Path(folder) / "works.c"
            source.write_text(_PROBE, encoding="utf-8")
            done = compiled(using, ["-shared", "-fPIC", str(source), "-o", f"{folder}/works.so", "-lm"])
    except OSError as error:
        return f"has no room to work: {(error.strerror or str(error)).lower()}"
    except CompilerError as error:
        return error.why
    return "" if done.code == 0 else done.failure


# ---------------------------------------------------------------------- remembered

_TROUBLE = "trouble-"
_known: dict[str, str] = {}


def trouble(key: str) -> str:
    """Reason of the failure that this or another process remembered under `key`; "" if there is none."""
    if key in _known:
        return _known[key]
    store = cache.persistent()
    return "" if store is None else _recorded(store, _file(key))


def _recorded(store: Cache, name: str) -> str:
    with suppress(ValueError, TypeError, KeyError):
        record = json.loads(store.read(name) or b"")
        if 0 <= time.time() - record["at"] <= min(float(record["for"]), LONG_REMEMBERED):
            return str(record["why"])
    return ""


def remember(key: str, why: str, *, seconds: float | None = None) -> None:
    """Remember a failure of the compiler under `key` for `seconds`, by default `REMEMBERED`.

    During that time the compiler is not tried again for the same purpose.
    """
    _known[key] = why
    store = cache.persistent()
    if store is not None:
        record = {"at": time.time(), "for": REMEMBERED if seconds is None else seconds, "why": why}
        store.write(_file(key), json.dumps(record).encode())


def remembered() -> list[str]:
    """Reasons of all remembered compiler failures, because of which the compiler is not tried at present."""
    store = cache.persistent()
    found = [] if store is None else [_recorded(store, name) for name in store.names(_TROUBLE)]
    return list(dict.fromkeys(filter(None, [*_known.values(), *found])))


def forget() -> None:
    """Forget which compilers failed, so that they are tried again."""
    _known.clear()
    _versions.clear()
    store = cache.persistent()
    if store is not None:
        for name in store.names(_TROUBLE):
            with suppress(OSError):
                (store.folder / name).unlink()


def _file(key: str) -> str:
    return f"{_TROUBLE}{key}.json"


# ---------------------------------------------------------------------- run


def run(command: Sequence[str], *, given: str = "") -> ProgramResult:
    """Run a program in its own POSIX session; kill it with its child processes if it exceeds the limits.

    If the wait is interrupted, the program and its child processes are killed, too.

    Args:
        command: the program and its arguments.
        given: text on the standard input.

    Raises:
        HangsError: the program used no processor time for `IDLE` seconds, more processor time than `BUSY`,
            more memory than `MEMORY`, or took longer than `ELAPSED`.
        OSError: the program cannot be started.
    """
    # files, not pipes: a surviving child process could keep a pipe open
    with (
        tempfile.TemporaryFile() as into,
        tempfile.TemporaryFile() as out,
        tempfile.TemporaryFile() as errors,
    ):
        into.write(given.encode())
        into.seek(0)
        process: subprocess.Popen[bytes] | None = None
        try:
            with _signals_deferred():
                process = subprocess.Popen(
                    command, stdin=into, stdout=out, stderr=errors, start_new_session=True
                )
            started = process
            with leaving(lambda _code: kill_session(started)):
                with suppress(ImportError, AttributeError, OSError, ValueError):
                    import resource

                    most = int(BUSY) + 5  # ends the program and its children even if this process ends first
                    resource.prlimit(process.pid, resource.RLIMIT_CPU, (most, most))
                _await(process)
        except BaseException:
            if process is not None:
                _end(process)
            raise
        texts = []
        for stream in (out, errors):
            stream.seek(0)
            texts.append(stream.read().decode(errors="replace"))
    return ProgramResult(process.returncode, *texts)


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Context in which SIGINT and SIGTERM are deferred while a process is started.

    Otherwise an interruption could leave a process that is not yet known, and so cannot be killed.
    """
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield
        return
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: received.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) not in (None, signal.SIG_IGN)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for each in received:
            signal.raise_signal(each)


def _await(process: subprocess.Popen[bytes]) -> None:
    """Wait until a process ends. Raises HangsError if it hangs or exceeds a limit, without killing it."""
    begun = since = time.monotonic()
    used = 0.0
    while True:
        with suppress(subprocess.TimeoutExpired):
            process.wait(min(IDLE / 4, 0.5))
            return
        now, found = time.monotonic(), _use(process.pid)
        if found is None:
            used, since = now - begun, now
        elif found.seconds > used:
            used, since = found.seconds, now
        if now - since >= IDLE:
            raise HangsError(f"did nothing for {IDLE:g} s and was ended")
        if now - begun >= ELAPSED:
            raise HangsError(f"did not end within {ELAPSED:g} s and was ended")
        if used >= BUSY:
            raise HangsError(f"did not end within {BUSY:g} s of the processor and was ended", worked=True)
        if found is not None and found.memory > MEMORY:
            raise HangsError(f"took more than {MEMORY / 1e9:g} GB of memory and was ended", worked=True)


@dataclass(frozen=True, slots=True)
class _Use:
    """Resources used by all processes of a POSIX session: processor time in seconds, memory in bytes."""

    seconds: float
    memory: int


def _use(session: int) -> _Use | None:
    """Return the resources used by the processes of the POSIX session `session`, including ended children.

    The result is None if they are unknown, as on systems without `/proc`.
    """
    ticks, pages, known = 0, 0, False
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            words = path.read_text(errors="replace").rpartition(")")[2].split()
            if int(words[3]) == session:
                ticks, pages, known = ticks + sum(map(int, words[11:15])), pages + int(words[21]), True
    if not known:
        return None
    return _Use(ticks / os.sysconf("SC_CLK_TCK"), pages * os.sysconf("SC_PAGE_SIZE"))


def _end(process: subprocess.Popen[bytes]) -> None:
    """Terminate all processes of the session that `process` leads; kill those that do not end in time."""
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(_GRACE)
    except subprocess.TimeoutExpired:
        pass
    finally:
        kill_session(process)
        process.wait()


def kill_session(process: subprocess.Popen[Any]) -> None:
    """Kill all processes of the session that `process` leads; on Windows, the process alone."""
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
