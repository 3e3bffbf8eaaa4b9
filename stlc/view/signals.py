"""What was driven: the signals of chosen traces, the robustness of every requirement beneath, who decided when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.signature import Column
from stlc.trace import Trace
from stlc.view.judged import TOLERANCE, Judged
from stlc.view.style import BLUE, FAINT, GREEN, INK, MUTED, ORANGE, RED, SKY, Picture, look, new_figure, quiet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POLICY, BACKUP, SAFEST = 0, 1, 2
DECISIONS = {POLICY: ("policy", FAINT), BACKUP: ("backup", ORANGE), SAFEST: ("safest prefix", RED)}
MOST_LINES = 8  # panels of numbers; beyond that those that move come first
_HEIGHTS = {"line": 0.62, "strip": 0.2, "robustness": 0.5, "decision": 0.2}


@dataclass(frozen=True, slots=True)
class Choice:
    """One trace to show and why it was chosen."""

    index: int
    title: str


def choose_traces(judged: Judged) -> tuple[Choice, ...]:
    """The worst trace and a typical one (median robustness); only one where there is only one."""
    order = np.argsort(judged.least, kind="stable")
    worst, typical = int(order[0]), int(order[len(order) // 2])
    if worst == typical:
        return (Choice(worst, f"trace {worst}"),)
    return Choice(worst, f"worst: trace {worst}"), Choice(typical, f"typical: trace {typical}")


def draw_signals(trace: Trace, judged: Judged, choices: Sequence[Choice]) -> Picture:
    """A column of panels per chosen trace."""
    rows = _rows(trace, judged)
    heights = [_HEIGHTS[kind] for kind, _ in rows]
    with look():
        figure = new_figure(9, sum(heights) + 0.07 * len(rows) + 0.55)
        figure.get_layout_engine().set(h_pad=0.02, w_pad=0.06, hspace=0.03, wspace=0.03)  # type: ignore[union-attr]
        grid = figure.subplots(
            len(rows), len(choices), squeeze=False, sharex=True, sharey="row", height_ratios=heights
        )
        for column, choice in enumerate(choices):
            grid[0][column].set_title(choice.title, pad=8)
            for row, (kind, name) in enumerate(rows):
                axes = grid[row][column]
                _draw_row(axes, kind, name, trace, judged, choice.index)
                if column == 0:
                    _name_row(axes, kind, name, trace)
            grid[-1][column].set_xlabel("time [s]")
            grid[-1][column].tick_params(labelbottom=True)
        grid[0][0].set_xlim(trace.times[0], trace.times[-1])
    shown = " and ".join(choice.title for choice in choices)
    return Picture(figure, f"Signals, decisions and robustness per requirement; {shown}.")


def _rows(trace: Trace, judged: Judged) -> list[tuple[str, str]]:
    """Numbers first, then what is discrete, who decided, and the requirements."""
    columns = trace.signature.columns
    rows = [("line", c.name) for c in columns if c.kind in ("real", "int")]
    if len(rows) > MOST_LINES:
        rows = [row for row in rows if np.ptp(trace.data[row[1]]) > 0][:MOST_LINES]
    rows += [("strip", c.name) for c in columns if c.kind in ("bool", "enum")]
    if _decisions(trace) is not None:
        rows.append(("decision", "decision"))
    return rows + [("robustness", name) for name in judged.names]


def _draw_row(axes: Axes, kind: str, name: str, trace: Trace, judged: Judged, index: int) -> None:
    match kind:
        case "line":
            _draw_line(axes, trace, name, index)
        case "strip":
            _draw_strip(axes, trace, trace.signature[name], index)
        case "decision":
            _draw_decisions(axes, trace, index)
        case _:
            _draw_robustness(axes, trace, judged, name, index)
    if kind != "decision":
        _mark_backup(axes, trace, index)


def _name_row(axes: Axes, kind: str, name: str, trace: Trace) -> None:
    label = name
    if kind == "line":
        unit = trace.signature[name].unit.text
        label = f"{name} [{unit}]" if unit not in ("", "1") else name
    axes.set_ylabel(label, rotation=0, ha="right", va="center", labelpad=6)
    axes.yaxis.set_label_coords(-0.085, 0.5)


def _draw_line(axes: Axes, trace: Trace, name: str, index: int) -> None:
    axes.plot(trace.times, _broken(trace.data[name][index]), color=INK, lw=1.1)
    axes.locator_params(axis="y", nbins=3)


def _broken(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """`values` with a gap where they jump (a reset, the next junction), so that no line suggests a passage."""
    span = float(np.nanmax(values) - np.nanmin(values)) if len(values) else 0.0
    jumps = np.flatnonzero(np.abs(np.diff(values)) > 0.4 * span) + 1 if span > 0 else np.array([], dtype=int)
    steps = np.abs(np.diff(values))
    if len(jumps) > 0.1 * len(values) or (len(steps) and np.median(steps[steps > 0] if steps.any() else [0]) > 0.3 * span):
        return values
    broken = values.copy()
    broken[jumps] = np.nan
    return broken


def _draw_strip(axes: Axes, trace: Trace, column: Column, index: int) -> None:
    """A discrete signal as coloured stretches with its labels written into them."""
    values = trace.data[column.name][index]
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
    return [(a, b, float(values[a])) for a, b in zip(edges[:-1], edges[1:], strict=True) if b > a]


def _decisions(trace: Trace) -> NDArray[np.int64] | None:
    """Who decided, (traces, steps), or None where that was not recorded."""
    recorded = trace.extras.get("decision")
    if recorded is None or recorded.ndim != 2 or len(recorded) != trace.traces:
        return None
    return recorded.astype(np.int64)


def _draw_decisions(axes: Axes, trace: Trace, index: int) -> None:
    decisions = _decisions(trace)
    assert decisions is not None
    for start, stop, value in _stretches(decisions[index].astype(np.float64)):
        _, color = DECISIONS.get(int(value), ("", MUTED))
        axes.axvspan(trace.t0 + start * trace.dt, trace.t0 + stop * trace.dt, color=color, lw=0)
    axes.set_ylim(0, 1)
    quiet(axes)


def _mark_backup(axes: Axes, trace: Trace, index: int) -> None:
    """Faint uprights at the instants where the backup acted."""
    decisions = _decisions(trace)
    if decisions is None:
        return
    for start, stop, value in _stretches(decisions[index].astype(np.float64)):
        if value != POLICY:
            _, color = DECISIONS.get(int(value), ("", MUTED))
            left, right = trace.t0 + start * trace.dt, trace.t0 + stop * trace.dt
            axes.axvspan(left, right, color=color, alpha=0.18, lw=0)


def _draw_robustness(axes: Axes, trace: Trace, judged: Judged, name: str, index: int) -> None:
    rho = judged.of(name)[index]
    rho = np.where(np.isposinf(rho), np.nan, rho)
    times = trace.times[: len(rho)]
    axes.axhline(0, color=MUTED, lw=0.7)
    axes.fill_between(times, rho, 0, where=rho >= -TOLERANCE, step="post", color=BLUE, alpha=0.16, lw=0)
    axes.fill_between(times, rho, 0, where=rho < -TOLERANCE, step="post", color=RED, alpha=0.3, lw=0)
    axes.step(times, rho, where="post", color=BLUE, lw=1)
    axes.step(times, np.where(rho < -TOLERANCE, rho, np.nan), where="post", color=RED, lw=1.4)
    axes.set_ylim(*_limits(judged.of(name)))
    axes.locator_params(axis="y", nbins=3)


def _limits(rho: NDArray[np.float64]) -> tuple[float, float]:
    """Down to the least value; large margins are cut so that violations stay visible; zero is always seen."""
    finite = rho[np.isfinite(rho)]
    if not len(finite):
        return -1.0, 1.0
    low, high = min(float(finite.min()), 0.0), max(float(np.quantile(finite, 0.95)), 0.0)
    if low < 0:
        high = min(high, 4 * -low)
    room = 0.12 * (high - low) or 1.0
    return low - room, high + room
