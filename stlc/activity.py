"""Activity of the running operation, and the message that shows it while nothing else is printed."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from stlc.escape import visible


class Pulse:
    """Progress message of an operation that prints nothing for a while: current activity and elapsed time.

    On a terminal, the message is a line that appears after `IN_TERMINAL` seconds without output and is
    removed before the next output. Elsewhere, a new line is written every `IN_LOG` seconds.
    """

    IN_TERMINAL, IN_LOG = 1.5, 28.0

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._doing: list[tuple[str, float]] = []
        self._last = 0.0
        self._shown = False
        self._beating = False

    @contextmanager
    def beating(self) -> Iterator[None]:
        """Context in which the progress message is shown, unless it is inside another one of this kind."""
        stream = sys.stderr
        if self._doing or stream is None:
            yield
            return
        ended, self._beating = threading.Event(), True
        self._last = time.monotonic()
        thread = threading.Thread(target=self._beat, args=(stream, ended), daemon=True)
        with self.doing("at work"):
            thread.start()
            try:
                yield
            finally:
                ended.set()
                self.note()
                self._beating = False

    @contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Context in which the progress message names the activity `what`; for "", no message is shown."""
        self._doing.append((what, time.monotonic()))
        self.note()
        try:
            yield
        finally:
            self._doing.pop()

    def now(self, what: str) -> None:
        """Change the name of the current activity to `what`; the elapsed time is not reset."""
        if self._doing:
            self._doing[-1] = what, self._doing[-1][1]

    def tell(self, text: str) -> None:
        """Write a line of progress that stays, where the message is shown."""
        if self._beating:
            self.note()
            with suppress(OSError, ValueError):
                sys.stderr.write(f"{visible(text)}\n")

    def note(self) -> None:
        """Prepare for output: remove the progress message from the terminal and restart its delay."""
        with self._lock:
            self._last = time.monotonic()
            if self._shown:
                self._shown = False
                with suppress(OSError, ValueError):
                    sys.stderr.write("\r\x1b[K")

    def _beat(self, stream: TextIO, ended: threading.Event) -> None:
        terminal = stream.isatty() and os.environ.get("TERM") != "dumb"
        silence = self.IN_TERMINAL if terminal else self.IN_LOG
        while not ended.wait(min(0.5, silence)):
            with self._lock, suppress(OSError, ValueError, IndexError):
                what, started = self._doing[-1]
                now = time.monotonic()
                if not what or now - self._last < silence:
                    continue
                text = f"{what}, {now - started:.0f} s"
                stream.write(f"\r\x1b[K{text}" if terminal else f"{text}\n")
                stream.flush()
                self._shown = terminal
                self._last = self._last if terminal else now


PULSE = Pulse()
"""Progress message of the running operation; only a program shows it."""
