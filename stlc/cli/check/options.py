"""Options of `stlc check`, and those about traces that `explain` and `plot` share with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from stlc.cli.check.judge import End, Question, time_step
from stlc.cli.framework.options import (
    RequireOption,
    RunsOption,
    SetOption,
    SystemOption,
    parse_overrides,
    parse_pairs,
)
from stlc.registry import SEMANTICS

Files = Annotated[
    list[str],
    typer.Argument(
        metavar="[SPEC] TRACE…",
        help="Traces (.npz, .csv, .parquet, .mat, .mcap, bags of ROS, or -), after a spec.",
    ),
]
When = Annotated[
    str | None, typer.Option(metavar="0|all|K|TIME", help="Judge at this sample or time, or at all starts.")
]
Ending = Annotated[End, typer.Option(help="If the trace is too short: bounds, an error, or cut windows.")]
Robustness = Annotated[
    str,
    typer.Option(
        metavar="NAME", help=f"Reported robustness: {', '.join(SEMANTICS.names)}. Verdicts are exact."
    ),
]
Tolerance = Annotated[
    float, typer.Option(help="A robustness of at least minus this is satisfied; 0: `>` is not `>=`.")
]
Out = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Write the robustness signals there (.npz, .csv, .mcap); a folder for several traces.",
    ),
]
Junit = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the verdicts there, as JUnit XML.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=0, help="Number of processes; 0: one per core.")]
Chunk = Annotated[
    int,
    typer.Option(min=0, metavar="SAMPLES", help="Read in chunks of this size; 0: only if the file is large."),
]


@dataclass(frozen=True, slots=True)
class Traces:
    """Options on reading and judging of traces."""

    spec: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The specification, instead of the trace's own.")
    ] = None
    system: SystemOption = None
    set_: SetOption = None
    require: RequireOption = None
    map_: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="SIGNAL=NAME", help="A signal's name in the trace; t is the clock."),
    ] = None
    resample: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", help="Resample to this time step: bool, int and enum are held, real is linear."
        ),
    ] = None
    max_gap: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="In longer gaps signals are unknown; default: three steps with --resample, else no gap.",
        ),
    ] = None
    dt: Annotated[
        str | None, typer.Option(metavar="TIME", help="Time between samples that have no clock, as 10ms.")
    ] = None
    runs: RunsOption = Path("runs")

    def question(self, **more: Any) -> Question:
        """The options as a `Question`; `more` are further fields of it. Raises UsageError (U101)."""
        asked = {
            "spec": self.spec,
            "system": self.system,
            "names": parse_pairs(self.map_, "--map", "SIGNAL=NAME", "v_lead=vlead"),
            "require": tuple(self.require or ()),
            "resample": time_step("--resample", self.resample),
            "overrides": parse_overrides(self.set_),
            "dt": time_step("--dt", self.dt),
            "max_gap": time_step("--max-gap", self.max_gap),
        }
        return Question(**{**asked, **more})


TRACES = Traces()
