"""`stlc report`: the page that shows a run."""

from __future__ import annotations

from pathlib import Path

import typer

from stlc.cli.options import JsonOption, RunArgument, RunsOption, describe
from stlc.cli.output import emit, emit_json


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        help=describe(
            "Write a self-contained report.html with the pictures of a run.",
            "stlc report latest",
            note="It goes into the run's folder: training curves, signals with the robustness of each "
            "requirement, and the animation of a simulation, as far as the run has them. The page "
            "opens without a network.",
        )
    )(report)


def report(
    run: RunArgument = "latest",
    runs: RunsOption = Path("runs"),
    as_json: JsonOption = False,
) -> None:
    """Write the report of `run` and print where it is."""
    from stlc.rundir import RunDir
    from stlc.view.report import write_report

    folder = RunDir.open(run, runs)
    write_report(folder)
    path = f"{folder.shown}/report.html"
    if as_json:
        emit_json("report/1", ok=True, exit_code=0, result={"run": folder.shown, "report": path})
    else:
        emit(path)
