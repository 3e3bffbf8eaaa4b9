"""Plants that crash, hang, lie or flood: each is a finding, and the next simulation works."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.plants import changed, read

from stlc.plants.plant import FindingError, Plant, PlantFinding
from stlc.trace import Trace

pytestmark = pytest.mark.apart

CODE = '''
import ctypes
import os
import signal
import subprocess
import sys
import time

import numpy as np


class Hostile:
    def reset(self, initial, params):
        self.mode, self.count = int(params["mode"]), 0
        if self.mode == 14:
            self.child()
        return [float(self.mode), 0.0]

    def step(self, inputs):
        self.count += 1
        if self.count == 5:
            found = getattr(self, "mode_%d" % self.mode, lambda: None)()
            if found is not None:
                return found
        return [float(self.mode), float(self.count)]

    def mode_0(self):
        """Well-behaved, but talks."""
        print("hello")
        print("x" * 1_000_000, file=sys.stderr)
        sys.stdin.read()

    def mode_1(self):
        print("last words", file=sys.stderr, flush=True)
        os._exit(7)

    def mode_2(self):
        ctypes.string_at(0)

    def mode_3(self):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            pass

    def mode_4(self):
        return [float("nan"), 1.0]

    def mode_5(self):
        return [0.0] * 3_000_000

    def mode_6(self):
        keep = []
        while True:
            keep.append(np.empty(10_000_000))

    def mode_7(self):
        raise ValueError("no such valve: \\x1b[31m")

    def mode_8(self):
        for number in range(3, 20):
            try:
                os.write(number, b"\\xff" * 100)
            except OSError:
                pass
        time.sleep(600)

    def mode_9(self):
        self.child()
        sys.exit(3)

    def mode_10(self):
        self.child()
        os._exit(3)

    def mode_11(self):
        self.child()
        os.kill(os.getpid(), signal.SIGSEGV)

    def mode_12(self):
        if (child := os.fork()) == 0:
            time.sleep(600)
        print("child", child, file=sys.stderr, flush=True)
        os._exit(3)

    def mode_13(self):
        """Well-behaved, but forks, and lets the other process do what it does itself."""
        os.fork()

    def child(self):
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        print("child", child.pid, file=sys.stderr, flush=True)
'''

FILE = """\
plant: 1
name: hostile
python: "hostile.py:Hostile"
time: {dt: 1 s, duration: 10 s}
param: {mode: {range: [0, 20]}}
output: {one: , two: }
limit: {time: 120 s, memory: 1500}
"""
SHORT = "{time: 1.5 s}"
ENDLESS = 3
"""The mode that ends by a time limit; to all others a busy machine may give as much time as it likes."""
REASONS = {
    1: ("crash", "exit code 7"),
    2: ("crash", "SIGSEGV"),
    ENDLESS: ("time limit", "1.5 s"),
    4: ("not finite", "`one` is nan"),
    5: ("wrong shape", "3,000,000 numbers"),
    6: ("memory", "out of memory"),
    7: ("error", "ValueError: no such valve"),
    8: ("bad message", "bytes"),
    9: ("error", "SystemExit: 3"),
    10: ("crash", "exit code 3"),
    11: ("crash", "SIGSEGV"),
    12: ("crash", "exit code 3"),
}


def hostile(folder: Path, **changes: str) -> Plant:
    (folder / "hostile.py").write_text(CODE)
    return Plant(read(changed(FILE, **changes), folder))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """One simulation of each kind, and then two that are well-behaved."""
    modes = [*REASONS, 13, 0]
    with hostile(tmp_path_factory.mktemp("endless"), limit=SHORT) as plant:
        (endless,) = plant.simulate(np.array([[float(ENDLESS)]]))
    with hostile(tmp_path_factory.mktemp("hostile")) as plant:
        found = plant.simulate(np.array([[float(mode)] for mode in modes if mode != ENDLESS]), jobs=2)
    found.insert(modes.index(ENDLESS), endless)
    return found


@pytest.mark.parametrize("mode", REASONS)
def test_a_failure_is_a_finding(runs, mode):
    finding = runs[list(REASONS).index(mode)].outcome
    assert isinstance(finding, PlantFinding)
    reason, said = REASONS[mode]
    assert finding.reason == reason
    assert said in finding.message
    assert finding.point == {"mode": mode}
    assert len(finding.stderr) <= 4000


def test_the_next_simulation_works(runs):
    for run in runs[-2:]:
        assert isinstance(run.outcome, Trace)
        assert run.outcome.data["two"][0].tolist() == [float(count) for count in range(11)]


def test_a_finding_says_when_and_what_was_printed(runs):
    found = {int(run.point[0]): run.outcome for run in runs}
    assert found[4].time == 4.0
    assert found[1].time is None
    assert found[1].stderr == "last words"
    assert "no such valve" in found[7].stderr
    assert "Traceback" in found[7].stderr


@pytest.mark.parametrize("mode", [9, 10, 11, 12])
def test_children_of_a_plant_end_with_it(runs, mode):
    told = runs[list(REASONS).index(mode)].outcome.stderr.partition("child ")[2].split()
    assert gone(int(told[0]))


def gone(pid: int) -> bool:
    """True if a process ends within a minute."""
    for _ in range(3000):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:  # also while it is being read
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


def test_a_run_in_parts_raises_its_finding(tmp_path):
    with hostile(tmp_path) as plant:
        parts = plant.parts(np.array([4.0]), samples=3)
        assert next(parts).samples == 2
        with pytest.raises(FindingError) as caught:
            list(parts)
    assert caught.value.finding.reason == "not finite"


def test_a_process_ends_with_the_one_that_started_it(tmp_path):
    (tmp_path / "hostile.py").write_text(CODE)
    (tmp_path / "hostile.yaml").write_text(FILE)
    code = """
import numpy, sys
from stlc.plants.plant import load_plant
plant = load_plant("hostile.yaml")
plant.simulate(numpy.array([[14.0]]))
process = plant._processes[0]
print(process._process.pid, process._said().split()[-1], process._watchdog.folder, flush=True)
sys.stdin.read()
"""
    home = str(Path(__file__).parents[2])
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": home},
    )
    assert parent.stdout is not None
    *numbers, scratch = parent.stdout.readline().decode().split()
    assert Path(scratch).is_dir()
    parent.send_signal(signal.SIGKILL)
    parent.communicate()
    assert all(gone(int(number)) for number in numbers)
    for _ in range(3000):
        if not Path(scratch).exists():
            return
        time.sleep(0.02)
    raise AssertionError(f"{scratch} is left")
