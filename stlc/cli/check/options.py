"""The options of `stlc check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.check.judge import End
from stlc.cli.framework.completion import requirement_names
from stlc.registry import SEMANTICS

Files = Annotated[
    list[str],
    typer.Argument(
        metavar="[SPEC] TRACE…",
        help="Traces (.npz, .csv, .parquet, .mat, .mcap, bags of ROS, or -), after a spec.",
    ),
]
Spec = Annotated[
    Path | None, typer.Option(metavar="FILE", help="The specification, instead of the trace's own.")
]
Require = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME", help="Judge this requirement only; repeatable.", autocompletion=requirement_names
    ),
]
When = Annotated[
    str | None, typer.Option(metavar="0|all|K|TIME", help="Judge at this sample or time, or at all starts.")
]
Ending = Annotated[End, typer.Option(help="Too short a trace: bounds, an error, cut windows.")]
Robustness = Annotated[
    str,
    typer.Option(
        metavar="NAME", help=f"Robustness that is told: {', '.join(SEMANTICS.names)}. Verdicts are exact."
    ),
]
Tolerance = Annotated[
    float, typer.Option(help="Robustness from minus this on is satisfied; 0: `>` is not `>=`.")
]
Names = Annotated[
    list[str] | None,
    typer.Option("--map", metavar="SIGNAL=NAME", help="A signal's name in the trace; t is the clock."),
]
Resample = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="Put the signals on a grid: bool, int, enum held, real linear."),
]
Step = Annotated[
    str | None, typer.Option(metavar="TIME", help="Time between samples that have no clock, as 10ms.")
]
MaxGap = Annotated[
    str | None,
    typer.Option(
        metavar="TIME",
        help="In longer gaps signals are unknown; three steps with --resample, else no gap may be.",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Write the robustness signals there (.npz, .csv, .mcap); a folder for several traces.",
    ),
]
Junit = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the verdicts there, as JUnit XML.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=0, help="Processes; 0: one a core.")]
Chunk = Annotated[
    int, typer.Option(min=0, metavar="SAMPLES", help="Read in pieces of this size; 0: if it has to be.")
]
Runs = Annotated[Path, typer.Option(help="Folder of all runs.")]
