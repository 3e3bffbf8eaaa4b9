"""Watchdog of a plant's process: it owns the folder for temporary files, and cleans up when stlc has ended.

It is a shell that waits for the end of its standard input. That end comes when `Watchdog.end` closes it, and
also when stlc is killed, even by SIGKILL. Then the shell kills the process group of the plant and removes its
folder.
"""

from __future__ import annotations

import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from secrets import token_hex

from stlc.plants.kinds import SCRATCH

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

    def watch(self, group: int) -> None:
        """Kill the process group `group` at the end, too."""
        self._lead.write(f"{group}\n".encode())

    def end(self) -> None:
        """Kill the process group, and remove the folder; any thread may call it, more than once."""
        with suppress(OSError):
            self._lead.close()
        self._process.wait()
