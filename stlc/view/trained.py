"""Training with a progress bar, in terminals and notebooks."""

from __future__ import annotations

from typing import Any

from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.launch import train_here
from stlc.controller.training.loop import Watch


def train(task: Task, *, progress: bool = True, **options: Any) -> Run:
    """Train a policy in a new folder below `runs/` and return the run.

    Args:
        task: problem to train for; see `stlc.compile`.
        progress: whether a bar is shown; in a terminal or a notebook only.
        options: arguments of `stlc.controller.training.launch.train_here`: `budget` in seconds, `steps`,
            `seed`, `method`, and the fields of `stlc.controller.training.config.TrainConfig`.

    Raises:
        UsageError: U101, `budget` is not a positive number, `steps` is below 1, `seed` is negative, or there
            is no such method.
    """
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
        return train_here(task, watch=watch, **options)
