"""Forced exit of an interrupted command that does not end in time.

Ctrl-C and SIGTERM raise an exception in the main thread, but only after a running library call returns. So a
second thread, the watchdog, receives the signal too, through a file descriptor. If the command is still
running `PATIENCE` seconds later, the watchdog calls the functions that were registered by `leaving` (they end
child processes, remove temporary files, and set the status of a run) and ends the process.
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
"""Seconds that an interrupted command has to end by itself."""
LAST = 0.3
"""Seconds for the clean-up after that."""
CHILD = "STLC_PATIENCE"
"""Environment variable that gives child processes a shorter `PATIENCE` than their parent's."""

_undone: dict[int, Callable[[int], object]] = {}
_armed: list[float] = []
_asked: list[int] = []
_numbers = iter(range(1 << 62))


@contextmanager
def leaving(undo: Callable[[int], object]) -> Iterator[None]:
    """Context during which a forced exit calls `undo` with the exit code, in another thread.

    Callers use it to remove temporary files and the like.
    """
    key = undoing(undo)
    try:
        yield
    finally:
        _undone.pop(key, None)


def undoing(undo: Callable[[int], object]) -> int:
    """Register `undo` for the rest of the process: a forced exit calls it with the exit code.

    Returns the number under which it is registered.
    """
    key = next(_numbers)
    _undone[key] = undo
    return key


def arm() -> None:
    """Start the watchdog thread, which forces an interrupted command to exit; call it in the main thread."""
    read, write = os.pipe()
    try:
        if hasattr(os, "set_blocking"):
            os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    except ValueError:  # not the main thread
        os.close(read)
        os.close(write)
        return
    # a forked process must not write to the file descriptor of its parent
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    threading.Thread(target=_wait, args=(read,), name="last resort", daemon=True).start()
    _armed.append(time.perf_counter())


def age() -> float:
    """Seconds since `arm` was called at the start of a command; 0 if stlc is used as a library."""
    return time.perf_counter() - _armed[0] if _armed else 0.0


def finish(code: int) -> int:
    """End an interrupted process immediately with the exit code `code`, since libraries take long to unload.

    If the process was not interrupted, return `code`, and ignore later signals so that they do not change the
    exit code.
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
