"""`stlc report`: the HTML report of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stlc.cli.framework.options import PythonOption, RunArgument, RunsOption
from stlc.cli.framework.output import PULSE, Answer, emit, say
from stlc.cli.framework.program import command
from stlc.escape import visible
from stlc.foreign import driving

if TYPE_CHECKING:
    from stlc.cli.framework.documents import WrittenReport


@command("stlc report latest")
def report(
    run: RunArgument = "latest", python: PythonOption = False, runs: RunsOption = Path("runs")
) -> Answer[WrittenReport]:
    """Write a self-contained report.html with the pictures of a run.

    The report is written to the run's folder. It shows training curves, signals with the robustness of each
    requirement, and the animation of a simulation, if available. The page needs no network. A world that is
    Python of the run draws its scenes only with --python.
    """
    from stlc.rundir import RunDir
    from stlc.view.contents import simulation_of
    from stlc.view.learning import Commands, driven_lines, learning_of_run
    from stlc.view.report import write_report
    from stlc.view.words import satisfied_sentence

    folder = RunDir.open(run, runs)
    with PULSE.doing("drawing the report"), driving(python):
        write_report(folder)
    simulation = simulation_of(folder) or {}
    world = simulation.get("world")
    path = f"{folder.shown}/report.html"
    record = folder.record()
    learning = learning_of_run(folder, Commands.of(folder.shown, record))
    result: WrittenReport = {"run": folder.shown, "report": path}
    if learning is not None:
        result["verdict"] = learning

    def show() -> None:
        if world and not python:
            say(f"the scene is drawn by {visible(world)}, Python of the run: `--python` runs it")
        driven = satisfied_sentence(simulation) if simulation else ""
        for line in [driven] if driven else driven_lines(record.get("result") or {}):
            say(line)
        if learning is not None:
            say(f"{learning.level}: {learning.sentence}")
            if learning.worst:
                say(learning.worst)
            for advice in learning.advice:
                say(f"what helps: {advice}")
        emit(visible(path))

    return Answer(result, show)
