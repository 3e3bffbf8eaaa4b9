"""The compiler: found, bounded in time, ended with all it started, and remembered where it fails."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stlc import toolchain
from stlc.toolchain import CompilerError, HangsError, compiled, remembered, run, trouble, works

SLEEPS = "#!/bin/sh\necho $$ >> {pids}\nsleep 1000 &\necho $! >> {pids}\nwait\n"


@pytest.fixture(autouse=True)
def quick(monkeypatch, tmp_path):
    monkeypatch.setattr(toolchain, "IDLE", 0.3)
    monkeypatch.setattr(toolchain, "_GRACE", 0.3)
    monkeypatch.setattr(toolchain, "_known", {})
    monkeypatch.setattr(toolchain, "_versions", {})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def sleeper(tmp_path):
    return program(tmp_path, "cc", SLEEPS)


def program(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text.format(pids=folder / "pids"))
    path.chmod(0o755)
    return path


def left(folder: Path) -> list[int]:
    """Processes that a program noted and that are still there; ended ones that nobody waited for are not."""
    noted = [int(word) for word in (folder / "pids").read_text().split()]
    until = time.monotonic() + 5.0  # a signal takes its time on a machine that is busy
    while there := [process for process in noted if _runs(process)]:
        if time.monotonic() > until:
            break
        time.sleep(0.02)
    return there


def _runs(process: int) -> bool:
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def test_what_a_program_gives():
    done = run(["sh", "-c", "cat; echo no >&2; exit 3"], given="yes")
    assert (done.code, done.out, done.errors) == (3, "yes", "no\n")


def test_one_that_sleeps_is_ended_with_all_it_started(sleeper, tmp_path):
    with pytest.raises(HangsError, match=r"did nothing for 0\.3 s and was ended"):
        run([str(sleeper)])
    assert left(tmp_path) == []


def test_one_that_will_not_be_asked_is_ended_too(tmp_path):
    deaf = program(tmp_path, "deaf", "#!/bin/sh\ntrap '' TERM\n" + SLEEPS[10:])
    with pytest.raises(HangsError):
        run([str(deaf)])
    assert left(tmp_path) == []


@pytest.mark.apart
@pytest.mark.skipif(sys.platform != "linux", reason="needs to know the processor time")
def test_one_that_works_is_waited_for_and_not_for_ever(monkeypatch):
    monkeypatch.setattr(toolchain, "IDLE", 5.0)  # a machine that is busy does nothing for a while
    assert run(["sh", "-c", "i=0; while [ $i -lt 300000 ]; do i=$((i+1)); done; echo $i"]).out == "300000\n"
    monkeypatch.setattr(toolchain, "BUSY", 0.2)
    with pytest.raises(HangsError, match=r"did not end within 0\.2 s of the processor") as ended:
        run(["sh", "-c", "while :; do :; done"])
    assert ended.value.worked


@pytest.mark.apart
def test_one_that_makes_slow_progress_is_not_waited_for_for_ever(monkeypatch):
    monkeypatch.setattr(toolchain, "IDLE", 5.0)
    monkeypatch.setattr(toolchain, "ELAPSED", 1.0)
    with pytest.raises(HangsError, match=r"did not end within 1 s and was ended"):
        run(["sh", "-c", "while :; do sleep 0.1; i=0; while [ $i -lt 2000 ]; do i=$((i+1)); done; done"])


@pytest.mark.skipif(sys.platform != "linux", reason="needs to know the memory")
def test_one_that_takes_much_memory_is_ended(monkeypatch):
    monkeypatch.setattr(toolchain, "MEMORY", 60_000_000)
    with pytest.raises(HangsError, match=r"took more than 0\.06 GB of memory") as ended:
        run([sys.executable, "-c", "import time; held = b'.' * 200_000_000; time.sleep(99)"])
    assert ended.value.worked


@pytest.mark.skipif(sys.platform != "linux", reason="limits of other processes")
def test_one_that_is_left_alone_ends_by_itself():
    assert run(["sh", "-c", "sleep 0.2; ulimit -t"]).out == f"{int(toolchain.BUSY) + 5}\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_the_middle_of_a_start_comes_after_it(monkeypatch, tmp_path, sleeper, number):
    """Order of starting and noting a compiler: one that is half begun could not be ended."""

    class StoppedError(Exception):
        pass

    def stop(*_):
        raise StoppedError

    class Interrupted(subprocess.Popen):
        def __init__(self, *args, **named):
            super().__init__(*args, **named)
            until = time.monotonic() + 5.0
            while not (tmp_path / "pids").exists() and time.monotonic() < until:
                time.sleep(0.01)
            os.kill(os.getpid(), number)
            time.sleep(0.01)

    monkeypatch.setattr(toolchain.subprocess, "Popen", Interrupted)
    before = signal.signal(number, stop)
    try:
        with pytest.raises(StoppedError):
            run([str(sleeper)])
        assert signal.getsignal(number) is stop
    finally:
        signal.signal(number, before)
    assert left(tmp_path) == []


def test_who_holds_its_output_is_not_waited_for(tmp_path):
    done = run(["sh", "-c", f"sleep 1000 & echo $! > {tmp_path}/pids; echo done"])
    assert done.out == "done\n"
    os.kill(int((tmp_path / "pids").read_text()), signal.SIGKILL)


def test_one_that_hung_is_not_asked_again_for_a_while(sleeper, tmp_path):
    with pytest.raises(CompilerError, match="did nothing"):
        compiled(str(sleeper), ["--version"])
    asked = (tmp_path / "pids").read_text()
    toolchain._known.clear()  # as another process
    with pytest.raises(CompilerError, match="did nothing"):
        compiled(str(sleeper), ["x.c"])
    assert (tmp_path / "pids").read_text() == asked
    assert remembered() == ["did nothing for 0.3 s and was ended"]
    (record,) = (tmp_path / "cache/stlc").iterdir()
    old = json.loads(record.read_text()) | {"at": time.time() - toolchain.REMEMBERED - 1}
    record.write_text(json.dumps(old))
    assert remembered() == []


def test_another_compiler_in_its_place_is_asked(sleeper, tmp_path):
    with pytest.raises(CompilerError):
        compiled(str(sleeper), ["--version"])
    program(tmp_path, "cc", "#!/bin/sh\necho a new one\n")
    assert compiled(str(sleeper), ["--version"]).out == "a new one\n"


@pytest.mark.parametrize(
    "text", ["", "[]", "{{", '{{"at": "soon", "why": "?"}}', '{{"at": 1e300, "why": "?"}}']
)
def test_damaged_memory_is_none(tmp_path, text):
    toolchain.remember("key", "fails")
    (record,) = (tmp_path / "cache/stlc").iterdir()
    record.write_text(text.format())
    toolchain._known.clear()
    assert trouble("key") == ""


def test_the_doctor_tries_it_again(sleeper, tmp_path):
    assert works(str(sleeper)) == "did nothing for 0.3 s and was ended"
    program(tmp_path, "cc", "#!/bin/sh\necho cc: fatal error: no licence >&2\nexit 7\n")
    assert works(str(sleeper)) == "fails with exit code 7: cc: fatal error: no licence"
    assert remembered() == []


def test_what_is_no_program(tmp_path):
    path = program(tmp_path, "cc", "no program")
    with pytest.raises(CompilerError, match="cannot be started: exec format error"):
        compiled(str(path), [])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_nothing_is_left_when_a_command_is_stopped(sleeper, tmp_path, number):
    variables = {**os.environ, "CC": str(sleeper), "PATH": "/usr/bin:/bin"}
    command = [sys.executable, "-m", "stlc", "doctor", "--quick"]
    process = subprocess.Popen(command, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    while not (tmp_path / "pids").exists() or (tmp_path / "pids").read_text().count("\n") < 2:
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    said = process.communicate(timeout=20)[1]
    assert b"Traceback" not in said
    assert process.returncode == (130 if number == signal.SIGINT else 143)
    assert left(tmp_path) == []
