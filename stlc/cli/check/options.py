"""Options on traces that `stlc check`, `explain` and `plot` share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from stlc.cli.check.judge import Question, betweens, clock_setting, time_step
from stlc.cli.framework.options import (
    RequireOption,
    RunsOption,
    SetOption,
    SystemOption,
    parse_overrides,
    parse_pairs,
)


@dataclass(frozen=True, slots=True)
class Traces:
    """Command-line options that say how traces are read and judged."""

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
        typer.Option(metavar="TIME", help="Judge on a grid of this step; every recorded sample counts."),
    ] = None
    between: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SIGNAL=HOW",
            help="Values between samples: hold, hold:0.5s (older is unknown), linear or angle.",
        ),
    ] = None
    max_gap: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="In longer gaps signals are unknown.",
            show_default="three steps with --resample, else no gap",
        ),
    ] = None
    dt: Annotated[
        str | None, typer.Option(metavar="TIME", help="Time between samples that have no clock, as 10ms.")
    ] = None
    clock: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:UNIT]", help="The clock and its unit: timestamp:us, header.stamp, frame:frames."
        ),
    ] = None
    fps: Annotated[
        float | None, typer.Option(metavar="N", help="Frames per second, for a clock that counts frames.")
    ] = None
    group: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Column that tells objects apart, a trace each; none: one trace."),
    ] = None
    columns: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Names of the columns of a table without a header.")
    ] = None
    runs: RunsOption = Path("runs")

    def question(self, **more: Any) -> Question:
        """Return the options as a `Question`; `more` sets further fields, such as `at`.

        Raises:
            UsageError: U101, the value of an option is malformed.
        """
        asked = {
            "spec": self.spec,
            "system": self.system,
            "names": parse_pairs(self.map_, "--map", "SIGNAL=NAME", "v_lead=vlead"),
            "require": tuple(self.require or ()),
            "resample": time_step("--resample", self.resample),
            "overrides": parse_overrides(self.set_),
            "dt": time_step("--dt", self.dt),
            "between": betweens(parse_pairs(self.between, "--between", "SIGNAL=HOW", "v_lead=hold")),
            "clock": clock_setting(self.clock, self.fps),
            "group": self.group or "",
            "columns": tuple(name.strip() for name in (self.columns or "").split(",") if name.strip()),
            "max_gap": time_step("--max-gap", self.max_gap),
        }
        return Question(**{**asked, **more})


TRACES = Traces()
