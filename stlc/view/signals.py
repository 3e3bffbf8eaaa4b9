"""What was driven: signals of chosen traces, beneath them every requirement's robustness and who decided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.sketch import DECIDED, DECIDERS
from stlc.escape import picture
from stlc.signature import Column
from stlc.trace import Trace
from stlc.view.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    MUTED,
    RED,
    SKY,
    Picture,
    look,
    narrow_gaps,
    new_figure,
    quiet,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Margins: TypeAlias = Mapping[str, NDArray[np.float64]]

POLICY, BACKUP, SAFEST, POLISHED = 0, 1, 2, 3
DECISIONS = {
    POLICY: (DECIDERS[POLICY], FAINT),
    **{source: (DECIDERS[source], DECIDED[source]) for source in (BACKUP, SAFEST, POLISHED)},
}
MOST_LINES = 10  # panels of numbers; beyond that those that move come first
MOST_LETTERS = 44  # of a title in one line
_HEIGHTS = {"line": 0.62, "strip": 0.2, "robustness": 0.5, "decision": 0.2}


@dataclass(frozen=True, slots=True)
class Choice:
    """One trace to show and why it was chosen."""

    index: int
    title: str


def choose_traces(
    least: NDArray[np.float64], names: Sequence[str] = (), acted: NDArray[np.int64] | None = None
) -> tuple[Choice, ...]:
    """The worst trace, and that in which the guard acted most, or a typical one; one where there is only one.

    Args:
        least: robustness per trace, (traces,); NaN where it is not known.
        names: how traces are called; by default by their number.
        acted: how often the guard acted in each, (traces,).
    """
    order = np.argsort(least, kind="stable")
    worst, other, word = int(order[0]), int(order[max(1, int(np.isfinite(least).sum())) // 2]), "typical"
    if acted is not None and acted.any():
        other, word = int(np.argmax(acted)), f"guard acted most, {int(acted.max())} times"
    called = names or [f"trace {index}" for index in range(len(least))]
    if worst == other:
        return (Choice(worst, called[worst]),)
    return Choice(worst, f"worst: {called[worst]}"), Choice(other, f"{word}: {called[other]}")


def acted_in(trace: Trace) -> NDArray[np.int64] | None:
    """How often something else than the policy decided, (traces,); None where that was not recorded."""
    decisions = _decisions(trace)
    return None if decisions is None else np.asarray((decisions != POLICY).sum(1))


def draw_signals(
    trace: Trace, margins: Margins, choices: Sequence[Choice], units: Mapping[str, str] | None = None
) -> Picture:
    """A column of panels per chosen trace.

    Args:
        trace: what was recorded.
        margins: requirement -> robustness at every sample, (traces, samples), NaN where undefined.
        choices: the traces to show.
        units: requirement -> that of its robustness, where it has one.
    """
    rows = _rows(trace, margins)
    heights = [_HEIGHTS[kind] for kind, _ in rows]
    with look():
        figure = new_figure(9, sum(heights) + 0.07 * len(rows) + 0.8)
        narrow_gaps(figure)
        grid = figure.subplots(
            len(rows), len(choices), squeeze=False, sharex=True, sharey="row", height_ratios=heights
        )
        for column, choice in zip(grid.T, choices, strict=True):
            column[0].set_title(_in_lines(choice.title), pad=8)
            for axes, (kind, name) in zip(column, rows, strict=True):
                _draw_row(axes, kind, name, _Agent(trace, margins, choice.index))
            column[-1].set_xlabel("time [s]")
            column[-1].tick_params(labelbottom=True)
        for axes, (kind, name) in zip(grid[:, 0], rows, strict=True):
            _name_row(axes, kind, name, trace, units or {})
        grid[0][0].set_xlim(trace.times[0], trace.times[-1])
        _legend(figure, trace, bool(margins))
    shown = " and ".join(choice.title for choice in choices)
    return Picture(figure, f"Signals, decisions and robustness per requirement; {shown}.")


def _legend(figure: Figure, trace: Trace, judged: bool) -> None:
    """What the colours are: margins that hold and do not, and who decided."""
    from matplotlib.patches import Patch

    handles = []
    if judged:
        handles += [
            Patch(color=BLUE, alpha=0.5, lw=0, label="to spare"),
            Patch(color=RED, lw=0, label="violated"),
        ]
    decisions = _decisions(trace)
    for source in sorted(set() if decisions is None else {*np.unique(decisions).tolist()} - {POLICY}):
        word, color = DECISIONS.get(int(source), ("", MUTED))
        handles.append(Patch(color=color, lw=0, label=f"{word} decided"))
    if handles:
        figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), handlelength=1.0)


@dataclass(frozen=True, slots=True)
class _Agent:
    """One trace of a recording."""

    trace: Trace
    margins: Margins
    index: int


def _rows(trace: Trace, margins: Margins) -> list[tuple[str, str]]:
    """Numbers first, then what is discrete, who decided, and the requirements."""
    columns = trace.signature.columns
    rows = [("line", c.name) for c in columns if c.kind in ("real", "int")]
    if len(rows) > MOST_LINES:
        rows = [row for row in rows if np.ptp(trace.data[row[1]]) > 0][:MOST_LINES]
    rows += [("strip", c.name) for c in columns if c.kind in ("bool", "enum")]
    if _decisions(trace) is not None:
        rows.append(("decision", "decision"))
    return rows + [("robustness", name) for name in margins]


def _in_lines(title: str) -> str:
    """What a panel is wide enough for; the name of the trace stands in a line of its own where it is not."""
    return title if len(title) <= MOST_LETTERS else title.replace(": ", ":\n", 1)


def left_out(trace: Trace) -> list[str]:
    """Names of the numbers that have no panel."""
    shown = {name for kind, name in _rows(trace, {}) if kind == "line"}
    return [c.name for c in trace.signature.columns if c.kind in ("real", "int") and c.name not in shown]


def _draw_row(axes: Axes, kind: str, name: str, agent: _Agent) -> None:
    match kind:
        case "line":
            _draw_line(axes, agent, name)
        case "strip":
            _draw_strip(axes, agent, agent.trace.signature[name])
        case "decision":
            _draw_decisions(axes, agent)
        case _:
            _draw_robustness(axes, agent, name)
    if kind in ("line", "robustness"):
        _mark_backup(axes, agent)


def _name_row(axes: Axes, kind: str, name: str, trace: Trace, units: Mapping[str, str]) -> None:
    unit = ""
    if kind == "line":
        unit = trace.signature[name].unit.text
    elif kind == "robustness":
        unit = units.get(name, "")
    label = f"{name} [{unit}]" if unit not in ("", "1") else name
    axes.set_ylabel(picture(label), rotation=0, ha="right", va="center", labelpad=6)
    axes.yaxis.set_label_coords(-0.085, 0.5)


def _draw_line(axes: Axes, agent: _Agent, name: str) -> None:
    axes.plot(agent.trace.times, _broken(agent.trace.data[name][agent.index]), color=INK, lw=1.1)
    axes.locator_params(axis="y", nbins=3)


def _broken(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """`values` with a gap where they jump (a reset, the next junction); a staircase stays whole."""
    steps = np.abs(np.diff(values))
    moves = steps[steps > 0]
    span = float(np.ptp(values))
    if not len(moves) or np.median(moves) > 0.3 * span:
        return values
    broken = values.copy()
    broken[1:][steps > 0.4 * span] = np.nan
    return broken


def _draw_strip(axes: Axes, agent: _Agent, column: Column) -> None:
    """A discrete signal as coloured stretches with its labels written into them."""
    trace = agent.trace
    values = trace.data[column.name][agent.index]
    labels = {value: label for label, value in column.labels} or {0.0: "", 1.0: "yes"}
    levels = sorted({*labels, *np.unique(values[np.isfinite(values)]).tolist()})
    tints = (FAINT, SKY, MUTED, BLUE, GREEN)
    for start, stop, value in _stretches(values):
        left, right = trace.times[start], trace.times[stop - 1] + trace.dt
        axes.axvspan(left, right, color=tints[levels.index(value) % len(tints)], alpha=0.75, lw=0)
        label = labels.get(value, f"{value:g}")
        if label and (right - left) > 0.08 * trace.dt * trace.samples:
            axes.text((left + right) / 2, 0.5, label, ha="center", va="center", fontsize=7, color=INK)
    axes.set_ylim(0, 1)
    quiet(axes)


def _stretches(values: NDArray[np.float64]) -> list[tuple[int, int, float]]:
    """(start, stop, value) of each run of equal values."""
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    return [(a, b, float(values[a])) for a, b in pairwise(edges) if b > a]


def _decisions(trace: Trace) -> NDArray[np.int64] | None:
    """Who decided, (traces, steps), or None where that was not recorded."""
    recorded = trace.extras.get("decision")
    if recorded is None or recorded.ndim != 2 or len(recorded) != trace.traces:
        return None
    return recorded.astype(np.int64)


def _draw_decisions(axes: Axes, agent: _Agent) -> None:
    trace, decisions = agent.trace, _decisions(agent.trace)
    assert decisions is not None
    for start, stop, value in _stretches(decisions[agent.index].astype(np.float64)):
        _, color = DECISIONS.get(int(value), ("", MUTED))
        axes.axvspan(trace.t0 + start * trace.dt, trace.t0 + stop * trace.dt, color=color, lw=0)
    axes.set_ylim(0, 1)
    quiet(axes)


def _mark_backup(axes: Axes, agent: _Agent) -> None:
    """Faint uprights at the instants where the backup acted."""
    trace, decisions = agent.trace, _decisions(agent.trace)
    if decisions is None:
        return
    for start, stop, value in _stretches(decisions[agent.index].astype(np.float64)):
        if value != POLICY:
            _, color = DECISIONS.get(int(value), ("", MUTED))
            left, right = trace.t0 + start * trace.dt, trace.t0 + stop * trace.dt
            axes.axvspan(left, right, color=color, alpha=0.13, lw=0)


def _draw_robustness(axes: Axes, agent: _Agent, name: str) -> None:
    rho = agent.margins[name][agent.index]
    rho = np.where(np.isposinf(rho), np.nan, rho)
    times = agent.trace.times[: len(rho)]
    axes.axhline(0, color=MUTED, lw=0.7)
    axes.fill_between(times, rho, 0, where=rho >= -TOLERANCE, step="post", color=BLUE, alpha=0.16, lw=0)
    axes.fill_between(times, rho, 0, where=rho < -TOLERANCE, step="post", color=RED, alpha=0.3, lw=0)
    axes.step(times, rho, where="post", color=BLUE, lw=1)
    axes.step(times, np.where(rho < -TOLERANCE, rho, np.nan), where="post", color=RED, lw=1.4)
    axes.set_ylim(*margin_limits(agent.margins[name]))
    axes.locator_params(axis="y", nbins=3)


def margin_limits(rho: NDArray[np.float64]) -> tuple[float, float]:
    """Down to the least value; large margins are cut so that violations stay visible; zero is always seen."""
    finite = rho[np.isfinite(rho)]
    if not len(finite):
        return -1.0, 1.0
    low, high = min(float(finite.min()), 0.0), max(float(np.quantile(finite, 0.95)), 0.0)
    if low >= -TOLERANCE:
        low = 0.0  # rounding: nothing to make visible
    else:
        high = min(high, 4 * -low)
    room = 0.12 * (high - low) or 1.0
    return low - room, high + room
