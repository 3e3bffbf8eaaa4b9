"""Watchdog of a plant's process: it owns the folder for temporary files, and cleans up when stlc has ended.

It is a shell that waits for the end of its standard input. That end comes when `Watchdog.end` closes it, and
also when stlc is killed, even by SIGKILL. Then the shell kills the process group of the plant and removes its
folder. Where there are no process groups (on Windows), `Watchdog.end` kills the process alone, and a process
whose stlc was killed ends at its next request.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from secrets import token_hex

from stlc.plants.kind import SCRATCH

_SCRIPT = """
mkdir -m 700 -- "$1" || exit 1
echo made
read -r group
cat > /dev/null
[ -z "$group" ] || kill -s KILL -- "-$group"
for _ in 1 2 3 4 5 6 7 8 9 10; do rm -rf -- "$1" && exit; sleep 0.1; done
"""


class Watchdog:
    """A folder for temporary files, and the process group that uses it, which end with this process.

    Attributes:
        folder: the folder; the watchdog makes and removes it.

    Raises:
        OSError: there is no shell, or no room for the folder.
    """

    def __init__(self) -> None:
        self.folder = str(Path(tempfile.gettempdir()) / f"{SCRATCH}{token_hex(8)}")
        self._process: subprocess.Popen[bytes] | None = None
        self._watched: subprocess.Popen[bytes] | None = None
        if not hasattr(os, "killpg"):
            Path(self.folder).mkdir(0o700)
            return
        self._process = subprocess.Popen(
            ["/bin/sh", "-c", _SCRIPT, "sh", self.folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._lead = self._process.stdin
        with self._process.stdout as answer:
            if answer.readline() != b"made\n":
                self.end()
                raise OSError(f"no folder can be made at `{self.folder}`")

    def watch(self, process: subprocess.Popen[bytes]) -> None:
        """Kill the process, which leads a group, with its group at the end, too."""
        self._watched = process
        if self._process is not None:
            self._lead.write(f"{process.pid}\n".encode())

    def end(self) -> None:
        """Kill the process, and remove the folder; any thread may call it, more than once."""
        if self._process is not None:  # before the process is waited for: then its number may be another's
            with suppress(OSError):
                self._lead.close()
            self._process.wait()
        if self._watched is not None:
            self._watched.kill()
            self._watched.wait()
        if self._process is None:
            shutil.rmtree(self.folder, ignore_errors=True)
