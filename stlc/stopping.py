"""The last resort of an interrupted command: it ends in time, whatever it is doing.

Ctrl-C and SIGTERM raise an exception in the main thread, which unwinds what was begun. That waits while a
library computes. So a thread is told of the signal too, by the system and not by the interpreter: where the
command has not ended `PATIENCE` seconds later it ends the process, after it has undone what must not stay
(`leaving`): programs that were started, temporary files, the status of a run.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

PATIENCE = 0.9
"""Seconds that an interrupted command has to unwind."""
LAST = 0.3
"""Seconds that are left then for what must not stay."""
CHILD = "STLC_PATIENCE"
"""Environment variable by which a command gives those that it starts less patience than it has itself."""

_undone: dict[int, Callable[[int], object]] = {}
_armed: list[float] = []
_asked: list[int] = []
_numbers = iter(range(1 << 62))


@contextmanager
def leaving(undo: Callable[[int], object]) -> Iterator[None]:
    """While the block runs, a forced end calls `undo` with the exit code, in another thread."""
    key = undoing(undo)
    try:
        yield
    finally:
        _undone.pop(key, None)


def undoing(undo: Callable[[int], object]) -> int:
    """Register `undo` for a forced end, as in `leaving`; returns its number."""
    key = next(_numbers)
    _undone[key] = undo
    return key


def arm() -> None:
    """Let this process end in time once it is interrupted; for the main thread of a command."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    try:
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    except ValueError:  # not the main thread
        os.close(read)
        os.close(write)
        return
    # a process that is forked from this one has its own end; it must not tell of it here
    os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    threading.Thread(target=_wait, args=(read,), name="last resort", daemon=True).start()
    _armed.append(time.perf_counter())


def age() -> float:
    """Seconds since the command began; 0 where stlc is not a process of its own."""
    return time.perf_counter() - _armed[0] if _armed else 0.0


def finish(code: int) -> int:
    """End an interrupted process at once with its code, the buffers written: libraries take long to unload.

    Gives the code back where nobody has interrupted it: what was asked for is done then, and a signal while
    libraries are unloaded does not take its exit code away.
    """
    if not _asked and code not in (128 + signal.SIGINT, 128 + signal.SIGTERM):
        with suppress(ValueError):  # not the main thread
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
        return code
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    atexit._run_exitfuncs()
    os._exit(code)


def _wait(read: int) -> None:
    numbers = b""
    while not {signal.SIGINT, signal.SIGTERM} & set(numbers):
        numbers = os.read(read, 64)
    number = signal.SIGTERM if signal.SIGTERM in numbers else signal.SIGINT
    _asked.append(number)
    time.sleep(_patience())
    code = 128 + number
    last = threading.Thread(target=_undo, args=(code,), daemon=True)
    last.start()
    last.join(LAST)
    os._exit(code)


def _patience() -> float:
    with suppress(ValueError):
        return min(max(float(os.environ.get(CHILD, PATIENCE)), 0.0), PATIENCE)
    return PATIENCE


def _undo(code: int) -> None:
    for undo in reversed(list(_undone.values())):
        with suppress(Exception):
            undo(code)
