"""Commands with plants that are killed: no process and no folder is left."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

pytestmark = [
    pytest.mark.apart,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are looked for in /proc"),
]

PLANT = """
import subprocess
import sys
import time


class Slow:
    def __init__(self, dt):
        self.child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])

    def reset(self, initial, params):
        self.x = params["k"]
        return [self.x]

    def step(self, inputs):
        time.sleep(0.02)
        open(f"{__import__('tempfile').gettempdir()}/{time.monotonic_ns()}", "w").close()
        self.x += inputs["u"]
        return [self.x]
"""
FILE = """\
plant: 1
name: slow
python: "slow.py:Slow"
time: {dt: 100 ms, duration: 5 s}
param: {k: {range: [0.5, 2]}}
input: {u: {range: [-1, 1], pieces: 4}}
output: {x: }
"""
COMMANDS = (
    ("simulate", "s.stl", "--plant", "slow.yaml"),
    ("falsify", "s.stl", "--plant", "slow.yaml", "--simulations", "50"),
    ("falsify", "s.stl", "--plant", "slow.yaml", "--jobs", "2"),
    ("certify", "s.stl", "--plant", "slow.yaml", "--share", "0.9"),
)
AT_ONCE = 4


def marked(mark: str) -> Iterator[str]:
    """Command lines of the processes with `mark` in their environment that have not ended."""
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (path / "environ").read_bytes():
                yield (path / "cmdline").read_text().replace("\0", " ")
        except OSError:
            continue


@pytest.mark.parametrize("kills", [8, pytest.param(500, marks=pytest.mark.slow)])
def test_a_killed_command_leaves_nothing(kills: int, tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(PLANT)
    (tmp_path / "slow.yaml").write_text(FILE)
    (tmp_path / "s.stl").write_text("signal x\nrequire r: always x < 1000\n")
    scratch, mark, rng = tmp_path / "scratch", f"mark-{uuid4()}", random.Random(1)
    scratch.mkdir()
    home = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": home, "TMPDIR": str(scratch), "STLC_MARK": mark}
    opened = 0
    for first in range(0, kills, AT_ONCE):
        running = [
            subprocess.Popen(
                [sys.executable, "-m", "stlc", *COMMANDS[i % len(COMMANDS)]],
                cwd=tmp_path,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            for i in range(first, min(first + AT_ONCE, kills))
        ]
        time.sleep(rng.uniform(0.0, 8.0))
        opened += len([*scratch.glob("stlc-plant-*")])
        for process in running:
            assert process.poll() is None, "it ended by itself"
            process.send_signal(signal.SIGKILL)
            process.wait()
        time.sleep(2.0)
        assert not [*marked(mark)]
        assert not [*scratch.glob("stlc-plant-*")]
    assert opened > 0
