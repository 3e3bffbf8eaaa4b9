"""A controller as files of ONNX, and what it says of itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from stlc.compile.backends.c.numbers import Untranslatable
from stlc.controller.guard import candidates as backup
from stlc.controller.training.run import spec_hash, system_hash
from stlc.diagnostics import Diagnostic, UsageError
from stlc.export.onnx_file import model_of, require_onnx
from stlc.export.onnx_graphs import deciding, falling, following, judging
from stlc.jsontext import dumps
from stlc.provenance import sha256
from stlc.runtime import Controller
from stlc.runtime.facts import DECIDE, FACTS, FALL, FOLLOW, FORMAT, JUDGE, Quantity
from stlc.version import __version__

if TYPE_CHECKING:
    from stlc.compile.backends.onnx.sheet import Value
    from stlc.controller.problem.task import Task
    from stlc.controller.training.run import Run

TIMED = 200
"""Decisions that are timed."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Milliseconds that a decision of one agent takes on one thread: the policy's plan, and the begun one."""

    median: float
    p99: float


def write_onnx(run: Run, folder: Path) -> None:
    """`decide.onnx`, `follow.onnx`, `judge.onnx`, `controller.json`, and `fall.onnx` where there is danger.

    Raises:
        UsageError: U101, the task holds something that has no form as a graph.
        MissingError: R301, `onnx` or `onnxruntime` is not installed.
    """
    require_onnx()
    task, facts = run.task, _facts(run)
    graphs: dict[str, Callable[[], dict[str, Value]]] = {
        DECIDE: lambda: deciding(task, run.network),
        FOLLOW: lambda: following(task, run.network),
        JUDGE: lambda: judging(task),
    }
    if task.compiled.safety:
        graphs[FALL] = lambda: falling(task)
    digests = {}
    for name, make in graphs.items():
        try:
            outputs = make()
        except Untranslatable as error:
            message = f"this task has no form as an ONNX graph: {error}"
            raise UsageError(Diagnostic("U101", message, help=("take --to torch instead",))) from error
        data = model_of(Path(name).stem, outputs, {"stlc": dumps(facts)})
        (folder / name).write_bytes(data)
        digests[name] = sha256(data)
    (folder / FACTS).write_text(dumps({**facts, "files": digests}, indent=1) + "\n", encoding="utf-8")


def _facts(run: Run) -> dict[str, object]:
    """Names, units, ranges, hashes, and what the backup policy tries."""
    task, grid = run.task, backup.grid_of(run.task)
    feedback = task.system.decl.feedback
    return {
        "format": FORMAT,
        "stlc": __version__,
        "run": run.dir.name,
        "spec": {"name": task.compiled.name, "sha256": spec_hash(run.dir)},
        "system": {"name": task.system.name, "sha256": system_hash(run.dir)},
        "states": [asdict(each) for each in _states(task)],
        "controls": [
            asdict(Quantity(each.name, str(each.unit), each.low, each.high)) for each in task.system.controls
        ],
        "feedback": None if feedback is None else asdict(feedback),
        "requirements": [rule.name for rule in task.rules],
        "dt": task.dt,
        "horizon": task.horizon,
        "backup": asdict(grid),
    }


def _states(task: Task) -> list[Quantity]:
    timers = {timer.name: timer.initial for timer in task.system.timers}
    parameters = {each.column.name for each in task.system.parameters}
    return [
        Quantity(
            each.name,
            str(each.unit),
            each.low,
            each.high,
            "timer" if each.name in timers else "parameter" if each.name in parameters else "",
            timers.get(each.name),
        )
        for each in task.system.signature.columns
    ]


def timed(task: Task, folder: Path) -> Latency:
    """How long the runtime takes in random states, the first ones apart."""
    controller = Controller.load(folder)
    taken = []
    for state in task.sample(TIMED, seed=8, dtype=torch.float64).numpy():
        begun = time.perf_counter()
        controller.decide(state)
        taken.append(1e3 * (time.perf_counter() - begun))
    median, p99 = np.percentile(taken[10:], (50, 99))
    return Latency(float(median), float(p99))
