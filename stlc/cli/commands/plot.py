"""`stlc plot`: recorded signals, with the robustness of each requirement below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.commands.check import options as given
from stlc.cli.framework.options import require_separate
from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.diagnostics import usage
from stlc.escape import visible

if TYPE_CHECKING:
    from stlc.grammar import ast
    from stlc.monitor.verdict import Monitor
    from stlc.signature import Column
    from stlc.trace import Trace
    from stlc.view.signals import Choice, Margins
    from stlc.view.style import Picture

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
    from stlc.rundir import recorded_trace
    from stlc.view import require_drawing
    from stlc.view.signals import draw_signals
    from stlc.view.verdicts import margins_of, marks_of, units_of

    require_drawing()
    path = recorded_trace(what, reading.runs)
    target = _target(output, path)
    require_separate([("--out", target)], (path, reading.spec, reading.system))
    question = reading.question(require=())
    loaded = load(path, question, planned=windows or places)  # plans name the places that they have to reach
    if len(loaded.traces) > 1:
        objects = f"{len(loaded.traces)} objects of different times"
        raise usage(f"`{path}` holds {objects}: choose one by --group NAME=VALUE")
    recorded, monitor, note = loaded.traces[0], loaded.monitor, loaded.note
    if places:
        shown = list(range(recorded.traces)) if trace is None else [trace]
        own = windows or bool(reading.spec or reading.require)
        picture = _map(monitor, _one(recorded, trace), reading.require or [], own=own)
    else:
        verdict = monitor.check(recorded, require=reading.require or [])
        margins, units = margins_of(verdict), units_of(verdict)
        choices = _choices(recorded, margins, trace, path.name)
        drawn = _as_declared(recorded, monitor.spec)
        marks = marks_of(verdict, drawn)
        picture = draw_signals(drawn, margins, choices, units, marks)
        shown = [choice.index for choice in choices]
    _save(picture, target)

    def show() -> None:
        for remark in filter(None, (f"trace {path}", note)):
            say(remark)
        emit(visible(str(target)))

    return Answer(PlottedTrace(str(path), str(target), shown), show)


def _target(output: Path | None, trace: Path) -> Path:
    target = output or trace.with_suffix(".svg")
    if target.suffix not in _FORMATS:
        advice = (f"its suffix is one of {' '.join(_FORMATS)}",)
        raise usage(f"`{target}` is no picture", *advice)
    return target


def _as_declared(trace: Trace, spec: ast.Spec) -> Trace:
    """Return the trace; a column without unit and type has those that the specification declares."""
    from stlc.grammar import ast
    from stlc.signature import Signature
    from stlc.units import parse_unit

    def declared(column: Column) -> Column:
        for item in spec.items:
            if isinstance(item, ast.Signal) and (item.column or item.name) == column.name:
                if item.unit and not column.unit.text:
                    return replace(column, unit=parse_unit(item.unit))
                if item.type and item.type.name == "bool":
                    return replace(column, kind="bool")
        return column

    return replace(trace, signature=Signature(tuple(map(declared, trace.signature.columns))))


def _one(trace: Trace, wanted: int | None) -> Trace:
    """Return trace number `wanted` of a file with several traces; if `wanted` is None, return all traces."""
    if wanted is None:
        return trace
    _require_trace(trace.traces, wanted)
    return replace(
        trace, data={name: rows[wanted : wanted + 1] for name, rows in trace.data.items()}, extras={}
    )


def _map(monitor: Monitor, trace: Trace, wanted: list[str], *, own: bool) -> Picture:
    """Picture of paths over the regions of the requirements, such as `dock` in `[x, y] in dock`.

    `wanted` are the names of the requirements; all if it is empty. With `own`, they decide which paths are
    violated; otherwise the specification for drives does, if the trace stores one. Raises UsageError (U101)
    if the requirements name no region.
    """
    from stlc.view.region_map import draw_map, map_of
    from stlc.view.verdicts import violating

    verdict = monitor.check(trace, require=wanted)
    chart = map_of(monitor.spec, verdict, trace, None if own else violating(trace, verdict))
    if chart is None:
        advice = ("a place is a region of two signals: `[x, y] in circle([0, 0], 1 m)`",)
        message = f"no requirement of `{monitor.spec.name}` names a place"
        raise usage(message, *advice)
    return draw_map(chart)


def _require_trace(traces: int, wanted: int) -> None:
    if wanted >= traces:
        advice = (f"they go from 0 to {traces - 1}",)
        raise usage(f"there is no trace {wanted}", *advice)


def _choices(trace: Trace, margins: Margins, wanted: int | None, file: str) -> tuple[Choice, ...]:
    import numpy as np

    from stlc.view.signals import Choice, acted_in, choose_traces
    from stlc.view.verdicts import trace_names

    names = trace_names(trace) if trace.traces > 1 else [file]
    if wanted is not None:
        _require_trace(len(names), wanted)
        return (Choice(wanted, names[wanted]),)
    per_trace = [np.nanmin(np.where(np.isnan(rho), np.inf, rho), axis=1) for rho in margins.values()]
    least = np.min(per_trace, axis=0) if per_trace else np.zeros(len(names))
    return choose_traces(np.where(np.isfinite(least), least, np.nan), names, acted_in(trace))


def _save(picture: Picture, target: Path) -> None:
    from stlc.files import atomic_path, write_atomic
    from stlc.view.style import picture_style

    match target.suffix:
        case ".svg":
            write_atomic(target, picture.svg())
        case ".png":
            picture.save_png(target)
        case _:
            with picture_style(), atomic_path(target) as beside:
                picture.figure.savefig(beside, format="pdf")
