"""Options on traces that `stlc check`, `explain` and `plot` share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from stlc.cli.check.judge import Question, time_step
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
            "max_gap": time_step("--max-gap", self.max_gap),
        }
        return Question(**{**asked, **more})


TRACES = Traces()
