"""Simulations with a progress bar and pictures, in terminals and notebooks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stlc.activity import PULSE
from stlc.assurance.options import SimulateOptions
from stlc.escape import visible
from stlc.options import Options

if TYPE_CHECKING:
    from rich.console import Console

    from stlc.assurance.plant_judge import PlantSimulation
    from stlc.assurance.simulated import Simulation
    from stlc.controller.deployment.simulator import Watch
    from stlc.controller.run.run import Run


@Options.taking(SimulateOptions)
def simulate(subject: Run | Path | str, options: SimulateOptions) -> Simulation | PlantSimulation:
    """Deploy a policy in the world of its system, without and with a guard, and judge its closed-loop runs.

    Trace, scene and results are written into the folder of the run.

    Args:
        subject: the run, or its folder, number, words or specification, or `latest`; with `method` also a
            specification, with `plant` a specification only.
        options: fields of `stlc.assurance.options.SimulateOptions`, such as `guard="paper"` and
            `seeds=range(20)`; times are in seconds.

    Raises:
        UsageError: U101, an option does not fit.
        RunError, SystemFileError: the run or a file is damaged, or the world fails.
    """
    if options.plant is not None:
        from stlc.assurance.plant_runs import plant_simulation

        return plant_simulation(str(subject), options)
    from rich.console import Console

    from stlc.assurance.simulated import simulation

    console = Console(stderr=True)
    run, found = simulation(subject, options, lambda _task, _setting, title, _asked: bar(title, console))
    return replace(found, **pictures(run)) if options.pictures else found


@contextmanager
def bar(title: str, console: Console) -> Iterator[Watch]:
    """Context with a progress bar, which is shown only in a terminal or a notebook.

    The context yields the function that updates the bar.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    hidden = not (console.is_terminal or console.is_jupyter)
    with Progress(*columns, console=console, transient=True, disable=hidden) as progress:
        bar = progress.add_task(visible(title), total=None)
        yield lambda moment: progress.update(bar, completed=moment.step, total=moment.steps)


def pictures(run: Run) -> dict[str, Any]:
    """Draw the animation and the report if matplotlib is installed; return kind of picture -> its path."""
    from stlc.view import available

    if not available():
        PULSE.tell("no pictures: they need the extra `plot` (see `stlc doctor`)")
        return {}
    from stlc.view.bullet import available as in_space
    from stlc.view.report import write_report
    from stlc.view.run_animation import animate, recorded_scene

    seen = recorded_scene(run.dir)
    if seen is not None and seen.stage is not None and not in_space():
        PULSE.tell("robots are drawn as lines: bodies need the extra `panda`")
    with PULSE.doing("drawing the animation"):
        gif = animate(run.dir)
    with PULSE.doing("drawing the report"):
        write_report(run.dir)
    drawn = {"report": f"{run.dir.shown}/report.html"}
    return drawn if gif is None else {"animation": f"{run.dir.shown}/{gif.name}", **drawn}
