"""Training with a progress bar, in terminals and notebooks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import open_folder
from stlc.controller.training.loop import Watch, prepare
from stlc.controller.training.options import TrainOptions
from stlc.diagnostics import usage
from stlc.options import Options


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownTraining(TrainOptions):
    """Options of a training, and whether a bar shows its progress, in a terminal or a notebook only."""

    progress: bool = True


@Options.taking(ShownTraining)
def train(task: Task, options: ShownTraining) -> Run:
    """Train a policy in a new folder below `runs/` and return the run.

    Args:
        task: problem to train for; see `stlc.compile`.
        options: fields of `stlc.controller.training.options.TrainOptions`, such as `budget` in seconds,
            `steps`, `seed` and `method`; and `progress`, False for no bar.

    Raises:
        UsageError: U101, `budget` is not a positive number, `steps` is below 1, `seed` is negative, or there
            is no such method.
    """
    chosen = options.given()
    progress, budget, steps, seed = (chosen.pop("progress"), options.budget, options.steps, options.seed)
    if budget is not None and not 0.0 < budget < math.inf:
        raise usage(f"a training time of {budget} s is not a positive number")
    if (isinstance(steps, int) and steps < 1) or (seed is not None and seed < 0):
        raise usage("a training has at least 1 step, and its seed is at least 0")
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[told]}"))
    hidden = not (progress and (console.is_terminal or console.is_jupyter))
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True, disable=hidden) as bar:
        shown = bar.add_task(task.compiled.name, total=1.0, told="")

        def row(found: dict[str, Any]) -> None:
            told = f"{found.get('accuracy', 0.0):.3f} of plans satisfy it"
            bar.update(shown, completed=found["step"] / max(found["steps"], 1), told=told)

        watch = Watch(row=row, evaluating=lambda text: bar.update(shown, told=text))
        config = TrainConfig(**chosen)
        return prepare(task, config).run(open_folder(task, config), watch).run
