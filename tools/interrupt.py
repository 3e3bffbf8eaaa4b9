"""Robustness test: commands that are interrupted, or run out of budget, at random moments.

`python tools/interrupt.py --count 200 --seed 0` starts 200 commands of all long-running kinds: training (with
a warm and a cold cache of kernels, without a C compiler, of missions, several runs side by side, resumed),
simulation, checks, explanations, exports, tables, pictures. Most get SIGINT or SIGTERM after a random time,
themselves or with their process group; the others have a budget. For each it is checked:

- it ends within 2 s of the signal, or has used no more processor time, on one core, than its budget plus 20 %
  and 10 s (independent of other load; a compiler that it has started counts);
- it takes at most 2 GB of memory, and so does each process that it has started;
- its exit code is that of the signal (or its normal one, if it ended before), without a traceback;
- no child process and no incomplete file is left;
- run folders are readable, and `stlc train --resume` resumes interrupted trainings.

A line of JSON per command goes to the standard output, the summary to the standard error. Exit code 1 if any
check failed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ANSWER = 2.0
"""Seconds from the signal to the end of the process."""
MEMORY = 2048
"""Memory limit in MB of a command, or of a child process."""
_FOREIGN = re.compile(r"matplotlib|torchinductor|\.ses$")
"""Temporary folders of libraries."""
MARK = "STLC_INTERRUPTED_COMMAND"
STLC = (sys.executable, "-m", "stlc")
CAR, SHIP, PATROL = (str(ROOT / "specs" / f"{name}.stl") for name in ("traffic", "ship_track", "patrol"))


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of long-running command.

    Attributes:
        name: of the kind.
        words: after `stlc`; `{runs}`, `{run}`, `{trace}` and `{stones}` are replaced.
        seconds: approximate run time; it is interrupted before.
        weight: relative frequency.
        budget: in seconds; then it is not interrupted.
        compiler: whether it finds a C compiler.
        cold: whether its cache of kernels is empty.
        trains: whether it makes a run.
    """

    name: str
    words: tuple[str, ...]
    seconds: float
    weight: int = 1
    budget: float = 0.0
    compiler: bool = True
    cold: bool = False
    trains: bool = False


def _train(
    name: str, spec: str, *options: str, seconds: float = 25.0, weight: int = 4, **more: object
) -> Kind:
    words = ("train", spec, "--runs", "{runs}", *options)
    return Kind(name, words, seconds, weight, trains=True, **more)  # type: ignore[arg-type]


def _budget(name: str, spec: str, seconds: float, *options: str, **more: object) -> Kind:
    words = ("--budget", f"{seconds:g}s", "--budget-clock", "processor", *options)
    return _train(f"{name}, budget", spec, *words, seconds=seconds, weight=1, budget=seconds, **more)


KINDS = (
    _train("train", CAR, "--budget", "20s"),
    _train("train, cold cache", SHIP, "--budget", "20s", cold=True),
    _train("train, no compiler", CAR, "--budget", "20s", compiler=False),
    _train("train, stepping stones", "{stones}", "--budget", "20s"),
    _train("train, stepping stones, no compiler", "{stones}", "--budget", "20s", compiler=False),
    _train("train, mission", PATROL, "--budget", "20s"),
    _train("train, gradient", CAR, "--method", "gradient", "--steps", "400", "--held-out", "500"),
    _train("train, side by side", CAR, "--seeds", "0..2", "--jobs", "2", "--budget", "8s", weight=3),
    _budget("train", CAR, 12.0),
    _budget("train, cold cache", SHIP, 12.0, cold=True),
    _budget("train, no compiler", SHIP, 12.0, compiler=False),
    _budget("train, mission", PATROL, 12.0),
    _budget("train, stepping stones", "{stones}", 15.0),
    _budget("train, stepping stones, no compiler", "{stones}", 15.0, compiler=False),
    Kind("resume", ("train", "--resume", "{copy}", "--budget", "20s"), 20.0, 3),
    Kind("simulate", ("simulate", "{copy}", "--seeds", "0..19"), 15.0, 3),
    Kind("simulate --backup", ("simulate", "{copy}", "--backup", "--seeds", "0..19"), 20.0, 3),
    Kind("simulate --guard full", ("simulate", "{copy}", "--guard", "full", "--seeds", "0..5"), 25.0, 3),
    Kind(
        "simulate, no compiler",
        ("simulate", "{copy}", "--backup", "--seeds", "0..5"),
        25.0,
        2,
        compiler=False,
    ),
    Kind("check", ("check", "{trace}", "--spec", "{long}"), 5.0, 3),
    Kind("check --jobs", ("check", *["{trace}"] * 6, "--spec", "{long}", "--jobs", "2"), 8.0, 2),
    Kind("explain", ("explain", "{trace}", "--spec", "{long}"), 6.0, 2),
    Kind("export", ("export", "{copy}", "--to", "onnx", "--out", "{runs}/export"), 15.0, 3),
    Kind("report", ("report", "{copy}"), 8.0, 2),
)


@dataclass(slots=True)
class Result:
    """Outcome of one command.

    Attributes:
        kind: of the command.
        number: its seed.
        sent: the signal, and when, in seconds; "" where it ran to its end.
        took: seconds from the signal to the end, or of the whole command where none was sent.
        allowed: seconds that it may take.
        memory: MB at most, of the command or of a process that it has waited for.
        code: its exit code.
        wrong: failed checks.
        said: end of its output if a check failed.
    """

    kind: str
    number: int
    sent: str = ""
    took: float = 0.0
    allowed: float = ANSWER
    memory: int = 0
    code: int = 0
    wrong: list[str] = field(default_factory=list)
    said: str = ""


@dataclass(frozen=True, slots=True)
class Stage:
    """Inputs of commands: a run, a long trace with a specification, a specification of many boxes."""

    home: Path

    def values(self, folder: Path) -> dict[str, str]:
        """Values of the placeholders of a command that runs in `folder`."""
        found = {name: str(self.home / name) for name in ("trace.npz", "long.stl", "stones.stl", "run")}
        copy = folder / "copy"
        shutil.copytree(self.home / "run", copy, symlinks=True)
        return {"runs": str(folder / "runs"), "copy": str(copy), "run": found["run"]} | {
            key: found[name]
            for key, name in (("trace", "trace.npz"), ("long", "long.stl"), ("stones", "stones.stl"))
        }


def prepare(home: Path) -> Stage:
    """Train a run, write a trace of a million samples and the specifications."""
    words = [*STLC, "train", CAR, "--budget", "8s", "--no-pictures", "--runs", str(home / "runs")]
    subprocess.run(words, check=True, capture_output=True)
    (found,) = (home / "runs" / "traffic").glob("0*")
    shutil.copytree(found, home / "run")
    import numpy as np

    time_axis = np.arange(1_000_000) * 0.01
    signal_ = np.sin(time_axis) + 0.1 * np.random.default_rng(0).standard_normal(len(time_axis))
    np.savez(home / "trace.npz", time=time_axis, x=signal_)
    (home / "long.stl").write_text(
        "spec long\nsignal x\nrequire r: always (x > 0.9 -> eventually[0, 20 s] x < -0.5)\n"
        "require q: always eventually[0, 10 s] (x > 0.5 until[0, 5 s] x > 0.8)\n"
    )
    boxes = [(0.5 + 0.45 * i, 0.5 + 0.3 * ((i * 7) % 5)) for i in range(15)]
    inside = " or ".join(f"(abs(x - {a:.2f}) <= 0.4 and abs(y - {b:.2f}) <= 0.4)" for a, b in boxes)
    (home / "stones.stl").write_text(
        'spec stones\nsystem "stones.yaml"\nsignal x [m]\nsignal y [m]\n'
        f"require on: always[0, 3 s] ({inside})\n"
        f"require there: eventually[0, 3 s] x >= {boxes[-1][0]:.2f}\n"
    )
    (home / "stones.yaml").write_text(STONES)
    return Stage(home)


STONES = """stlc: 1
name: stones
time: {dt: 0.1 s, horizon: 30 steps}
state:
  x: {unit: m, range: [-10, 20]}
  y: {unit: m, range: [-10, 20]}
control:
  vx: {unit: m/s, range: [-3, 3], squash: tanh}
  vy: {unit: m/s, range: [-3, 3], squash: tanh}
flow:
  x: vx
  y: vy
init:
  mixture:
    - draw: {x: "uniform(0.2, 0.8)", y: "uniform(0.2, 0.8)"}
"""


def one(stage: Stage, number: int, slow: float, kinds: tuple[Kind, ...]) -> Result:
    """Start a command, stop it or let it use up its budget, and check what it leaves."""
    draw = random.Random(number)
    kind = draw.choices(kinds, [each.weight for each in kinds])[0]
    result = Result(kind.name, number)
    folder = stage.home / f"work-{number}"
    (folder / "tmp").mkdir(parents=True)
    try:
        _watched(stage, kind, folder, draw, slow, result)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return result


def _watched(
    stage: Stage, kind: Kind, folder: Path, draw: random.Random, slow: float, result: Result
) -> None:
    values = stage.values(folder)
    words = [*STLC, *(word.format(**values) for word in kind.words)]
    environment = {
        **os.environ,
        MARK: str(result.number),
        "TMPDIR": str(folder / "tmp"),
        "PYTHONPATH": str(ROOT),
    }
    if kind.cold:
        environment["XDG_CACHE_HOME"] = str(folder / "cache")
    if not kind.compiler:
        environment |= {"PATH": str(folder), "CC": ""}
    with (folder / "said").open("wb") as said:
        began = time.monotonic()
        process = subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=said, env=environment, cwd=folder, start_new_session=True
        )
        if kind.budget:
            os.sched_setaffinity(process.pid, {min(os.sched_getaffinity(0))})
        signalled = not kind.budget and _signal(process, kind, draw, slow, result)
        since = time.monotonic() if signalled else began
        result.allowed = ANSWER if signalled or not kind.budget else 1.2 * kind.budget + 10.0
        _wait(process, 60.0 if signalled else 900.0, since, kind, result)
    if process.poll() is None:
        result.wrong.append("did not end")
        os.killpg(process.pid, signal.SIGKILL)
    elif result.took > result.allowed and (signalled or kind.budget):
        result.wrong.append(f"took {result.took:.2f} s")
    if result.memory > MEMORY:
        result.wrong.append(f"took {result.memory} MB")
    result.code = process.wait()
    _look(kind, folder, values, result, signalled=signalled)


def _wait(process: subprocess.Popen[bytes], most: float, since: float, kind: Kind, result: Result) -> None:
    """Wait for the end; record seconds since the signal, or processor time with a budget, and memory."""
    deadline = time.monotonic() + most
    while time.monotonic() < deadline and process.returncode is None:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        result.took = time.monotonic() - since
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            result.memory = usage.ru_maxrss // 1024
            result.took = usage.ru_utime + usage.ru_stime if kind.budget else result.took
            return
        time.sleep(0.005)


def _signal(
    process: subprocess.Popen[bytes], kind: Kind, draw: random.Random, slow: float, result: Result
) -> bool:
    """Send a signal at a random moment; False where the command was quicker."""
    delay = draw.uniform(0.3, kind.seconds) * slow
    _wait(process, delay, time.monotonic(), kind, result)
    if process.returncode is not None:
        return False
    number = signal.SIGTERM if draw.random() < 0.25 else signal.SIGINT
    group = draw.random() < 0.5
    result.sent = f"{number.name}{' to the group' if group else ''} after {delay:.1f} s"
    with suppress(ProcessLookupError):
        if group:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
    return True


def _look(kind: Kind, folder: Path, values: dict[str, str], result: Result, *, signalled: bool) -> None:
    """Check output, files and processes of a command, and whether its runs can be resumed."""
    said = (folder / "said").read_text(errors="replace")
    good = {128 + signal.SIGINT, 128 + signal.SIGTERM} if signalled else set()
    before = result.code in (-signal.SIGINT, -signal.SIGTERM) and not said  # Python itself had not started
    if result.code not in good | {0, 1, 4} and not before:
        result.wrong.append(f"exit code {result.code}")
    if "Traceback" in said or "B001" in said:
        result.wrong.append("traceback")
    time.sleep(0.2)
    left = _processes(result.number)
    if left:
        result.wrong.append(f"left {len(left)} processes: {left[:3]}")
        for pid in left:
            with suppress(OSError):
                os.kill(pid, signal.SIGKILL)
    result.wrong += _broken_files(folder)
    runs = sorted((folder / "runs").glob("*/0*")) if kind.trains else []
    if "--resume" in kind.words:
        runs = [Path(values["copy"])]
    for run in runs:
        _goes_on(run, result)
    if result.wrong:
        result.said = said[-1500:]


def _broken_files(folder: Path) -> list[str]:
    """Leftover temporary files, and incomplete JSON documents."""
    wrong = []
    files = [path for path in folder.rglob(".*") if path.suffix not in ("", ".lock") or len(path.stem) > 20]
    temporary = [path for path in (folder / "tmp").rglob("*") if not _FOREIGN.search(str(path))]
    if files or temporary:
        wrong.append(f"left files: {[path.name for path in (*files, *temporary)][:4]}")
    for path in folder.rglob("*.json"):
        with suppress(OSError):
            try:
                json.loads(path.read_text())
            except ValueError:
                wrong.append(f"half written: {path.relative_to(folder)}")
    return wrong


def _processes(number: int) -> list[int]:
    """Surviving processes of a command."""
    mark = f"{MARK}={number}".encode()
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if (
                mark in (path / "environ").read_bytes().split(b"\0")
                and b"Z" not in ((path / "stat").read_bytes().rpartition(b")")[2].split()[:1])
            ):
                found.append(int(path.name))
    return found


def _goes_on(run: Path, result: Result) -> None:
    """Resume a run for a moment."""
    record = run / "run.json"
    if not record.exists():
        result.wrong.append(f"no record in {run.name}")
        return
    status = json.loads(record.read_text()).get("status")
    if status == "running":
        result.wrong.append(f"{run.name} is still called running")
    if result.sent and status != "finished":
        words = [*STLC, "train", "--resume", str(run), "--budget", "1s", "--no-pictures"]
        done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=run.parent)
        if done.returncode not in (0, 1):
            result.wrong.append(f"does not go on: {done.returncode}")
            result.said += done.stderr[-800:]


def main() -> int:
    """Run the commands and report failed checks."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--slow", type=float, default=1.0, help="by how much signals are sent later")
    parser.add_argument("--only", default="", help="kinds whose name holds this")
    options = parser.parse_args()
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell's `&` lets it be ignored, by children too
    kinds = tuple(kind for kind in KINDS if options.only in kind.name)
    with tempfile.TemporaryDirectory(prefix="interrupt-") as home, ThreadPoolExecutor(options.jobs) as pool:
        stage = prepare(Path(home))
        numbers = range(options.seed, options.seed + options.count)
        results = []
        for result in pool.map(lambda number: one(stage, number, options.slow, kinds), numbers):
            results.append(result)
            print(json.dumps(asdict(result)), flush=True)
    print(summary(results), file=sys.stderr)
    return int(any(result.wrong for result in results))


def summary(results: list[Result]) -> str:
    """Number of commands that ended in time, the slowest response of each kind, and failed checks."""
    stopped = [result for result in results if result.sent]
    lines = [
        f"{len(results)} commands, {len(stopped)} interrupted, "
        f"{sum(result.allowed != ANSWER for result in results)} with a budget to keep, "
        f"{sum(not result.wrong for result in results)} as they should be"
    ]
    count = Counter(result.kind for result in results)
    for kind in sorted(count):
        answers = sorted(result.took for result in stopped if result.kind == kind)
        whole = sorted(result.took for result in results if result.kind == kind and not result.sent)
        parts = [f"{kind:<42} {count[kind]:>3}"]
        if answers:
            parts.append(f"answered in {answers[len(answers) // 2]:.2f} s, at most {answers[-1]:.2f} s")
        if whole:
            parts.append(f"{len(whole)} to the end, at most {whole[-1]:.1f} s")
        parts.append(f"{max(result.memory for result in results if result.kind == kind)} MB")
        lines.append("  ".join(parts))
    lines += [
        f"{result.kind} ({result.number}, {result.sent}): {'; '.join(result.wrong)}"
        for result in results
        if result.wrong
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
