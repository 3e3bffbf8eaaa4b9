"""Repeated execution of a command whenever a file changes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

from stlc.activity import PULSE
from stlc.cli.framework.output import say, show_diagnostics
from stlc.diagnostics import StlcError

PERIOD = 0.3


def watch(files: Iterable[str], action: Callable[[], object], *, rounds: int | None = None) -> None:
    """Call `action` now, and after each change of a file, until Ctrl-C.

    Args:
        files: paths of the watched files.
        action: function to call; errors that it raises are printed.
        rounds: number of polls; None: without end.
    """
    paths = [Path(file) for file in files]
    before = None
    while rounds is None or rounds > 0:
        now = [_stamp(path) for path in paths]
        if now != before:
            before = now
            try:
                action()
            except StlcError as error:
                show_diagnostics(error.diagnostics)
            say(f"watching {', '.join(map(str, paths))}; Ctrl-C stops")
        if rounds is not None:
            rounds -= 1
        if rounds is None or rounds > 0:
            with PULSE.doing(""):
                time.sleep(PERIOD)


def _stamp(path: Path) -> tuple[int, int]:
    """Modification time (ns) and size of a file, to detect changes; (0, 0) if the file is missing."""
    try:
        status = path.stat()
    except OSError:
        return (0, 0)
    return (status.st_mtime_ns, status.st_size)
