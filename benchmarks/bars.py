"""Figures of the comparison: plan accuracy as bars, and plan accuracy over the processor time per plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.curves import COLUMNS
from stlc.files import File
from stlc.view import available
from stlc.view.style import BLUE, GREEN, INK, MUTED, ORANGE, PINK, SKY, Picture, new_figure, picture_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BARS, TIMES = "img/comparison.svg", "img/plan_times.svg"
"""The figures, relative to the page."""
MARKS = "os^Dv<>Ph*"
PALETTE = (BLUE, ORANGE, GREEN, PINK, SKY, INK, MUTED)


@dataclass(frozen=True, slots=True)
class Bar:
    """Plan accuracy of one method, with its confidence interval; `plans` is True for a planner."""

    label: str
    accuracy: float
    interval: tuple[float, float]
    plans: bool


@dataclass(frozen=True, slots=True)
class Point:
    """Plan accuracy of one method with one time budget; `ms` is the processor time per plan."""

    label: str
    ms: float
    accuracy: float


@dataclass(frozen=True, slots=True)
class Facet:
    """Data of one benchmark in the figures: its bars and points.

    `feasible` is the share of initial states from which a satisfying plan is known, or None.
    """

    title: str
    bars: tuple[Bar, ...]
    points: tuple[Point, ...]
    feasible: float | None = None


def draw(facets: Sequence[Facet], folder: Path) -> tuple[Picture, ...]:
    """Draw both figures, write them as SVG files below `folder`, and return them.

    The result is empty if matplotlib is missing or nothing is measured.
    """
    shown = [each for each in facets if each.bars]
    if not shown or not available():
        return ()
    names = list(dict.fromkeys(bar.label for facet in shown for bar in facet.bars))
    bars = _grid(shown, lambda axes, facet: _draw_bars(axes, facet, names), 0.16 * len(names) + 0.7)
    times = _grid(shown, lambda axes, facet: _draw_points(axes, facet, names), 2.2)
    File(folder / BARS).write(bars.svg())
    File(folder / TIMES).write(times.svg())
    return bars, times


def _grid(shown: Sequence[Facet], drawn: Callable[[Axes, Facet], None], height: float) -> Picture:
    rows, columns = -(-len(shown) // COLUMNS), min(len(shown), COLUMNS)
    with picture_style():
        figure = new_figure(3.0 * columns + 0.6, height * rows + 0.5)
        grid = figure.subplots(rows, columns, squeeze=False)
        for index, axes in enumerate(grid.flat):
            axes.set_visible(index < len(shown))
            if index < len(shown):
                axes.set_title(shown[index].title)
                drawn(axes, shown[index])
                if index % columns:  # the first column labels the others too
                    axes.set_ylabel("")
                    axes.tick_params(labelleft=False)
        handles = {
            label: handle
            for axes in grid.flat
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        if handles:
            figure.legend(
                [*handles.values()], [*handles], loc="outside lower center", ncols=5, handlelength=1.6
            )
    best = (f"{each.title} {max(bar.accuracy for bar in each.bars):.3f}" for each in shown)
    return Picture(figure, f"Plan accuracy of all methods; the best: {', '.join(best)}.")


def _draw_bars(axes: Axes, facet: Facet, names: Sequence[str]) -> None:
    places = {name: len(names) - place for place, name in enumerate(names)}
    for bar in facet.bars:
        below, above = bar.accuracy - bar.interval[0], bar.interval[1] - bar.accuracy
        axes.barh(
            *(places[bar.label], bar.accuracy),
            height=0.7,
            color=ORANGE if bar.plans else BLUE,
            ecolor=INK,
            xerr=[[max(0.0, below)], [max(0.0, above)]],
            error_kw={"lw": 0.8},
        )
    for name in places.keys() - {bar.label for bar in facet.bars}:  # an empty row would read as accuracy 0
        axes.text(0.02, places[name], "no result", color=MUTED, size="small", va="center")
    axes.set_yticks([*places.values()], [*places])
    axes.set_ylim(0.4, len(names) + 0.6)
    axes.set_xlim(0.0, 1.02)
    _feasible(facet, axes.axvline)


def _draw_points(axes: Axes, facet: Facet, names: Sequence[str]) -> None:
    for place, name in enumerate(names):
        own = sorted((each for each in facet.points if each.label == name), key=lambda each: each.ms)
        if own:
            axes.plot(
                [each.ms for each in own],
                [each.accuracy for each in own],
                color=PALETTE[place % len(PALETTE)],
                marker=MARKS[place % len(MARKS)],
                ms=3.6,
                lw=1.0,
                label=name,
            )
    axes.set_xscale("log")
    axes.set_xlabel("processor time a plan [ms]")
    axes.set_ylabel("plan accuracy")
    axes.set_ylim(0.0, 1.05)
    _feasible(facet, axes.axhline)


def _feasible(facet: Facet, line: Callable[..., object]) -> None:
    if facet.feasible is not None:
        line(facet.feasible, color=MUTED, lw=1.0, ls=(0, (4, 2)))
