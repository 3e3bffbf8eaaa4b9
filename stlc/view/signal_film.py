"""The film of a trace without a world or places: every agent's signals, drawn up to now."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from stlc.trace import Trace
from stlc.view.film import Film
from stlc.view.strip import veil
from stlc.view.style import BLUE, INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_PANELS, MOST_AGENTS = 6, 40


def signal_film(trace: Trace, *, title: str = "") -> Film:
    """The signals of all agents in panels."""
    names = [c.name for c in trace.signature.columns if c.kind in ("real", "int")][:MOST_PANELS]
    names = names or list(trace.signature.names[:MOST_PANELS])

    def begin(figure: Figure) -> Callable[[int], None]:
        grid = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        panels = [_panel(axes, trace, name) for axes, name in zip(grid, names, strict=True)]
        head = grid[0].set_title(f"{title}   {trace.times[-1]:.1f} s")
        grid[-1].set_xlabel("time [s]")
        figure.draw_without_rendering()
        figure.set_layout_engine("none")

        def turn(index: int) -> None:
            head.set_text(f"{title}   {trace.times[index]:.1f} s")
            for panel in panels:
                panel(index)

        return turn

    height = 0.7 + 0.8 * len(names)
    alt = f"{title}: signals of {trace.traces} agents."
    return Film(trace.samples, trace.dt, (6.4, height), begin, alt, trace.samples - 1)


def _panel(axes: Axes, trace: Trace, name: str) -> Callable[[int], None]:
    """One signal of at most `MOST_AGENTS` agents; all curves are one line with gaps, veiled from now on."""
    values = trace.data[name][:MOST_AGENTS]
    gap = np.full((len(values), 1), np.nan)
    unit = trace.signature[name].unit.text
    axes.set_ylabel(f"{name}\n[{unit}]" if unit not in ("", "1") else name)
    times = np.broadcast_to(trace.times, values.shape)
    axes.plot(np.hstack([times, gap]).ravel(), np.hstack([values, gap]).ravel(), color=INK, lw=0.8, alpha=0.7)
    (present,) = axes.plot([], [], "o", color=BLUE, ms=3, zorder=5)
    cover = veil(axes, trace.times)

    def turn(index: int) -> None:
        present.set_data(times[:, index], values[:, index])
        cover.turn(index)

    return turn
