"""`stlc plot`: recorded signals, with the robustness of each requirement below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.commands.check import options as given
from stlc.cli.framework.options import require_separate
from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.diagnostics import usage
from stlc.escape import visible

_FORMATS = (".svg", ".png", ".pdf")


@dataclass(frozen=True, slots=True)
class PlottedTrace:
    """Picture of a recording, and the numbers of the traces that it shows."""

    trace: str
    picture: str
    shown: Sequence[int]


@command(
    "stlc plot trace.npz",
    "stlc plot latest --require give_way -o give_way.svg",
    "stlc plot latest --places -o map.png",
)
def plot(
    what: Annotated[str, typer.Argument(metavar="TRACE|RUN", help="A trace, or a run with one.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="The picture.", show_default="beside the trace, .svg"
        ),
    ] = None,
    trace: Annotated[int | None, typer.Option(min=0, metavar="K", help="Trace number K of the file.")] = None,
    places: Annotated[
        bool, typer.Option("--places", help="Paths over the places of the specification.")
    ] = False,
    windows: Annotated[
        bool, typer.Option("--windows", help="Judge by the specification of the plans, from every start.")
    ] = False,
    reading: given.Traces = given.TRACES,
) -> Answer[PlottedTrace]:
    """Draw signals, and below them the robustness of the requirements.

    For a run, the trace in its folder is drawn, judged as `stlc check` judges it. The worst and a typical
    trace are shown unless --trace selects one. With --places all paths are drawn over the regions of the
    requirements, such as `dock` in `[x, y] in dock`. The suffix of -o selects the format: .svg, .png or .pdf.
    """
    from stlc.monitor.check import load
    from stlc.rundir import RunDir
    from stlc.view import require_drawing
    from stlc.view.plotted import plotted_places, plotted_signals, save_picture

    require_drawing()
    path = RunDir.recorded_trace(what, reading.runs)
    target = output or path.with_suffix(".svg")
    if target.suffix not in _FORMATS:
        raise usage(f"`{target}` is no picture", f"its suffix is one of {' '.join(_FORMATS)}")
    require_separate([("--out", target)], (path, reading.spec, reading.system))
    question = reading.question(require=())
    loaded = load(path, question, planned=windows or places)  # plans name the places that they have to reach
    if len(loaded.traces) > 1:
        objects = f"{len(loaded.traces)} objects of different times"
        raise usage(f"`{path}` holds {objects}: choose one by --group NAME=VALUE")
    recorded, monitor, note = loaded.traces[0], loaded.monitor, loaded.note
    wanted = reading.require or []
    if places:
        own = windows or bool(reading.spec or reading.require)
        drawn = plotted_places(monitor, recorded, trace, wanted, own=own)
    else:
        drawn = plotted_signals(monitor, recorded, trace, wanted, path.name)
    save_picture(drawn.picture, target)

    def show() -> None:
        for remark in filter(None, (f"trace {path}", note)):
            say(remark)
        emit(visible(str(target)))

    return Answer(PlottedTrace(str(path), str(target), drawn.shown), show)
