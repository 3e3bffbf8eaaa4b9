"""An interrupted command ends in time: work stops in parts, and what does not unwind is ended."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from stlc import stopping

STUBBORN = """
import signal, sys, time
from stlc import stopping
stopping.arm()
signal.signal(signal.SIGINT, lambda *_: None)
signal.signal(signal.SIGTERM, lambda *_: None)
def undo(code):
    open(sys.argv[1], "w").write(str(code))
with stopping.leaving(undo), stopping.leaving(lambda _code: 1 / 0):
    print("ready", flush=True)
    while True:
        time.sleep(0.01)
"""


@pytest.mark.apart
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_does_not_unwind_is_ended_and_undone(tmp_path: Path, number: int) -> None:
    words = [sys.executable, "-c", STUBBORN, str(tmp_path / "undone")]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(number)
        code = process.wait(timeout=60)
    assert code == 128 + number
    assert (tmp_path / "undone").read_text() == str(code)


UNLOADING = """
import atexit, sys, time
from stlc import stopping
stopping.arm()
atexit.register(time.sleep, 1.0)
atexit.register(print, "unloading", flush=True)
sys.exit(stopping.finish(4))
"""


@pytest.mark.apart
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_done_keeps_its_exit_code(number: int) -> None:
    with subprocess.Popen([sys.executable, "-c", UNLOADING], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"unloading\n"
        process.send_signal(number)
        assert process.wait(timeout=60) == 4


def test_what_came_to_its_end_is_not_undone() -> None:
    before = dict(stopping._undone)
    with stopping.leaving(lambda _code: None):
        assert len(stopping._undone) == len(before) + 1
    assert stopping._undone == before


def test_children_have_less_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(stopping.CHILD, "0.1")
    assert stopping._patience() == 0.1
    for text in ("never", "-1", "1e9"):
        monkeypatch.setenv(stopping.CHILD, text)
        assert 0.0 <= stopping._patience() <= stopping.PATIENCE
