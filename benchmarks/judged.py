"""Control tasks in folders, driven by the commands of stlc and judged by programs that know nothing of it.

A folder of a task holds one or more specifications with their systems, and `judge.py`. `judge.py TRACE.npz`
prints a line `NAME k of n` for each rule, and `all k of n`. If there is no judge, `stlc check` judges.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stlc.diagnostics import StlcError, usage
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.provenance import sha256

JUDGE = "judge.py"
JUDGING = 600.0
"""Seconds that a judge may take."""
_COUNT = re.compile(r"^(\S+)\s+(\d+) of (\d+)", re.MULTILINE)


class NoAnswerError(Exception):
    """A command or a judge that gave no result; the message says why."""


@dataclass(frozen=True, slots=True)
class ControlTask:
    """A task: a specification in a folder, with its system and judge.

    Attributes:
        name: name of the folder, followed by that of the specification if the folder has several.
        spec: path of the specification.
    """

    name: str
    spec: Path

    @property
    def judge(self) -> Path | None:
        """Path of the judge; None if there is none."""
        path = self.spec.parent / JUDGE
        return path if path.is_file() else None

    @property
    def hashes(self) -> dict[str, str]:
        """File name -> SHA-256, of the specification and of all files beside it but other specifications."""
        beside = (path for path in self.spec.parent.iterdir() if path.is_file() and path.suffix != ".stl")
        return {path.name: sha256(path.read_bytes()) for path in sorted({*beside, self.spec})}


def tasks_in(folder: Path) -> tuple[ControlTask, ...]:
    """Return the tasks in the folders of `folder`, by name; a specification without a system is none.

    Raises:
        UsageError: U102, there is no such folder, or no task in it.
    """
    found = []
    for place in sorted(path for path in folder.glob("*") if path.is_dir()):
        specs = [path for path in sorted(place.glob("*.stl")) if _has_system(path)]
        found += [
            ControlTask(place.name if len(specs) == 1 else f"{place.name}/{each.stem}", each)
            for each in specs
        ]
    if not found:
        raise usage(f"there is no task in a folder of `{folder}`", code="U102")
    return tuple(found)


def _has_system(path: Path) -> bool:
    try:
        return Spec.parse(File(path).read()).system is not None
    except StlcError:
        return True  # the commands say what is wrong with it


@dataclass(frozen=True, slots=True)
class Verdicts:
    """Number of trajectories that obey, in all and rule by rule.

    Attributes:
        obeyed: number of trajectories that obey all rules.
        count: number of trajectories.
        rules: rule -> number of trajectories that obey it.
    """

    obeyed: int
    count: int
    rules: Mapping[str, int]

    @property
    def lacking(self) -> str:
        """Rules that some trajectories violate with the numbers that obey; "" if there are none."""
        return ", ".join(f"{name} {held}" for name, held in self.rules.items() if held < self.count)


def judged(task: ControlTask, trace: Path) -> Verdicts:
    """Judge the trajectories in the file `trace` (.npz, arrays (trajectories, samples)) by the task's judge.

    Raises:
        NoAnswerError: the judge fails, as on a trace that ends too early for it.
    """
    if task.judge is None:
        result = asked("check", str(task.spec), str(trace), limit=JUDGING)
        count = int(result["traces"])
        held = {each["name"]: count - int(each["violated_traces"]) for each in result["requirements"]}
        return Verdicts(int(result["satisfied_traces"]), count, held)
    try:
        done = _ended([sys.executable, str(task.judge), str(trace)], JUDGING)
        counts = {name: (int(held), int(of)) for name, held, of in _COUNT.findall(done.stdout)}
        if done.returncode or "all" not in counts:
            raise NoAnswerError(_last_line(done.stderr) or "it prints no line `all N of M`")
    except NoAnswerError as error:
        raise NoAnswerError(f"{JUDGE}: {error}; the trace ends at {end_of(trace):g} s") from None
    obeyed, count = counts.pop("all")
    return Verdicts(obeyed, count, {name: held for name, (held, _) in counts.items()})


def end_of(trace: Path) -> float:
    """Return the last time in a trace file (.npz), in seconds."""
    with np.load(trace, allow_pickle=False) as arrays:
        return float(arrays["t"][-1])


def asked(*arguments: str, limit: float) -> dict[str, Any]:
    """Run a command of stlc with `--json` in a process with one thread, and return the result that it prints.

    Raises:
        NoAnswerError: the command takes longer than `limit` seconds or prints no result; the message is that
            of its diagnostics, or the last line of its errors.
    """
    done = _ended([sys.executable, "-m", "stlc", *arguments, "--json"], limit)
    try:
        document = json.loads(done.stdout)
    except ValueError:
        raise NoAnswerError(_last_line(done.stderr) or f"exit code {done.returncode}") from None
    if document.get("result") is None:
        messages = [f"{each['code']} {each['message']}" for each in document.get("diagnostics", ())]
        raise NoAnswerError("; ".join(messages) or f"exit code {done.returncode}")
    return dict(document["result"])


def _ended(command: Sequence[str], limit: float) -> subprocess.CompletedProcess[str]:
    alone = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    try:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=limit, check=False, env={**os.environ, **alone}
        )
    except subprocess.TimeoutExpired:
        raise NoAnswerError(f"no end within {limit:g} s") from None


def _last_line(text: str) -> str:
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")
