"""Pictures of recordings: signals with the robustness of the requirements below, and paths over places."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stlc.diagnostics import usage
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.monitor.judgement import Verdict
from stlc.signature import Column, Signature
from stlc.trace import Trace
from stlc.units import Unit
from stlc.view import require_drawing
from stlc.view.signals import Choice, acted_in, choose_traces, draw_signals
from stlc.view.style import Picture, picture_style
from stlc.view.verdicts import margins_of, marks_of, trace_names, units_of, violating

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from stlc.monitor.verdict import Monitor


@dataclass(frozen=True, slots=True)
class Plotted:
    """Picture of a recording, and the numbers of the traces that it shows."""

    picture: Picture
    shown: tuple[int, ...]


def plot(verdict: Verdict) -> Figure:
    """Draw the judged signals, with thresholds and deciding values, and the robustness at each sample.

    Of several traces, the worst and a typical one are drawn. `verdict` is that of `stlc.check` or
    `Monitor.check`.

    Raises:
        MissingError: R301, matplotlib is not installed.
    """
    require_drawing()
    given, columns = verdict.subject.signals, verdict.subject.compiled.signature.columns
    data = {name: np.asarray(values).T for name, values in given.env.items()}
    named = Signature(tuple(column for column in columns if column.name in data))
    trace = given.trace or Trace(named, verdict.about.dt or 1.0, data, given.t0)
    return picture_of(verdict, trace).figure


def picture_of(verdict: Verdict, trace: Trace) -> Picture:
    """Picture of a verdict on a trace; of several, the worst and a typical one are drawn."""
    return _signals(verdict, trace, trace, trace_names(trace)).picture


def plotted_signals(
    monitor: Monitor, trace: Trace, number: int | None, wanted: list[str], file: str
) -> Plotted:
    """Draw signals, and below them the robustness of the requirements.

    Args:
        monitor: specification that judges the recording.
        trace: the recording. Columns without unit and type are drawn with those that the specification
            declares.
        number: trace to draw; None for the worst and a typical one.
        wanted: names of the requirements; all if it is empty.
        file: name of a recording with one trace.

    Raises:
        UsageError: U101, there is no trace of this number.
    """
    names = trace_names(trace) if trace.traces > 1 else [file]
    verdict = monitor.check(trace, require=wanted)
    return _signals(verdict, trace, _as_declared(trace, monitor.spec), names, number)


def _signals(
    verdict: Verdict, trace: Trace, drawn: Trace, names: list[str], number: int | None = None
) -> Plotted:
    margins = margins_of(verdict)
    if number is None:
        least = np.full(len(names), np.inf if margins else 0.0)
        for rho in margins.values():
            least = np.fmin(least, np.fmin.reduce(rho, 1))
        least[~np.isfinite(least)] = np.nan
        choices = choose_traces(least, names, acted_in(trace))
    else:
        _require_trace(len(names), number)
        choices = (Choice(number, names[number]),)
    picture = draw_signals(drawn, margins, choices, units_of(verdict), marks_of(verdict, drawn))
    return Plotted(picture, tuple(choice.index for choice in choices))


def plotted_places(
    monitor: Monitor, trace: Trace, number: int | None, wanted: list[str], *, own: bool
) -> Plotted:
    """Draw paths over the regions of the requirements, such as `dock` in `[x, y] in dock`.

    Args:
        monitor: specification with the requirements.
        trace: the recording.
        number: trace to draw; None for all.
        wanted: names of the requirements; all if it is empty.
        own: whether they decide which paths are violated. Otherwise the specification for drives does, if the
            recording stores one.

    Raises:
        UsageError: U101, the requirements name no region, or there is no trace of this number.
    """
    from stlc.view.region_map import draw_map, map_of

    shown = tuple(range(trace.traces))
    if number is not None:
        _require_trace(trace.traces, number)
        data = {name: rows[number : number + 1] for name, rows in trace.data.items()}
        shown, trace = (number,), replace(trace, data=data, extras={})
    verdict = monitor.check(trace, require=wanted)
    chart = map_of(monitor.spec, verdict, trace, None if own else violating(trace, verdict))
    if chart is None:
        advice = "a place is a region of two signals: `[x, y] in circle([0, 0], 1 m)`"
        raise usage(f"no requirement of `{monitor.spec.name}` names a place", advice)
    return Plotted(draw_map(chart), shown)


def _require_trace(traces: int, number: int) -> None:
    if number >= traces:
        raise usage(f"there is no trace {number}", f"they go from 0 to {traces - 1}")


def _as_declared(trace: Trace, spec: Spec) -> Trace:
    """Return the trace; a column without unit and type has those that the specification declares."""

    def declared(column: Column) -> Column:
        for item in spec.signals:
            if (item.column or item.name) == column.name:
                if item.unit and not column.unit.text:
                    return replace(column, unit=Unit.parse(item.unit))
                if item.type and item.type.name == "bool":
                    return replace(column, kind="bool")
        return column

    return replace(trace, signature=Signature(tuple(map(declared, trace.signature.columns))))


def save_picture(picture: Picture, target: Path) -> None:
    """Write a picture as SVG, PNG or PDF, by the suffix of its file."""
    match target.suffix:
        case ".svg":
            File(target).write(picture.svg())
        case ".png":
            picture.save_png(target)
        case _:
            with picture_style(), File(target).replaced() as beside:
                picture.figure.savefig(beside, format="pdf")
