"""`stlc report`: the HTML report of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.framework.options import RunArgument
from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.escape import visible
from stlc.options import Options

if TYPE_CHECKING:
    from stlc.view.report import Report


@command("stlc report latest")
def report(
    run: RunArgument = "latest", python: Options.Python = False, runs: Options.Runs = Path("runs")
) -> Answer[Report]:
    """Write a self-contained report.html with the pictures of a run.

    The report is written to the run's folder. It shows training curves, signals with the robustness of each
    requirement, and the animation of a simulation, if available. The page needs no network. A world that is
    Python of the run draws its scenes only with --python.
    """
    from stlc.view.contents import simulation_of
    from stlc.view.report import report as write

    found = write(run, python=python, runs=runs)

    def show() -> None:
        world = (simulation_of(found.run) or {}).get("world")
        if world and not python:
            say(f"the scene is drawn by {visible(world)}, Python of the run: `--python` runs it")
        for line in found.lines:
            say(line)
        emit(visible(found.shown))

    return Answer(found, show)
