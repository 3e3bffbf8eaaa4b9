"""Figure of plan accuracy over training time on a logarithmic axis, one panel per benchmark.

A dashed line shows the share of initial states from which a satisfying plan is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.training import Cell
from stlc.files import File
from stlc.view import available
from stlc.view.style import BLUE, GREEN, INK, MUTED, ORANGE, PINK, SKY, Picture, new_figure, picture_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from benchmarks.feasible import KnownFeasible
    from benchmarks.store import Result

PICTURE = "img/results.svg"
"""The picture, relative to the page."""
COLORS = {"guided": BLUE, "gradient": ORANGE, "ppo": GREEN, "pets": PINK, "mbpo": SKY}
"""Colours of methods; those of a method with several rewards differ in their lines."""
LINES = {"robustness": "-", "task": "--", "accuracy": ":"}
"""Lines of the curves of a reward."""
TICKS = {10: "10 s", 60: "1 min", 300: "5 min", 3600: "1 h"}
COLUMNS = 3


@dataclass(frozen=True, slots=True)
class Curve:
    """Learning curve of one training run.

    Attributes:
        method: name of the training method, with its reward if it has several.
        seconds: training time at each point.
        accuracies: plan accuracy at each point, on new random initial states.
        end: (training time in seconds, final accuracy on held-out initial states).
    """

    method: str
    seconds: tuple[float, ...]
    accuracies: tuple[float, ...]
    end: tuple[float, float]

    @classmethod
    def of(cls, result: Result) -> Curve:
        """Return the learning curve that is stored in the result of a training run."""
        points = [(float(point["seconds"]), float(point["accuracy"])) for point in result["curve"]]
        times, accuracies = zip(*points, strict=True) if points else ((), ())
        return cls(Cell.of(result).contender, times, accuracies, (result["seconds"], result["accuracy"]))


@dataclass(frozen=True, slots=True)
class Panel:
    """Data of one panel of the figure, which shows one benchmark.

    Attributes:
        title: title of the panel.
        curves: one curve per training run.
        feasible: share of initial states from which a satisfying plan is known, or None.
    """

    title: str
    curves: tuple[Curve, ...]
    feasible: float | None


def draw_results(results: Sequence[Result], known: Mapping[str, KnownFeasible | None], path: Path) -> bool:
    """Draw the longest training run of each method and seed, and write the figure as an SVG file to `path`.

    The keys of `known` are the benchmarks, each of which gets a panel. Its values are the shares of initial
    states from which a satisfying plan is known, or None. Returns False if matplotlib is missing or nothing
    was measured.
    """
    longest: dict[str, dict[tuple[object, ...], Result]] = {}
    for each in sorted(results, key=lambda each: float(each["seconds"])):
        key = each["key"]
        longest.setdefault(key["benchmark"], {})[Cell.of(each).contender, key["seed"]] = each
    panels = [
        Panel(name, tuple(map(Curve.of, longest[name].values())), None if share is None else share.share)
        for name, share in known.items()
    ]
    picture = draw_benchmarks(panels) if available() else None
    if picture is not None:
        File(path).write(picture.svg())
    return picture is not None


def draw_benchmarks(panels: Sequence[Panel]) -> Picture | None:
    """Draw all panels with curves, three in a row; return None if no panel has a curve."""
    shown = [panel for panel in panels if panel.curves]
    if not shown:
        return None
    rows, columns = -(-len(shown) // COLUMNS), min(len(shown), COLUMNS)
    with picture_style():
        figure = new_figure(3.1 * columns + 0.4, 2.3 * rows + 0.3)
        grid = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
        for axes, panel in zip(grid, shown, strict=False):
            _draw_panel(axes, panel)
        for axes in grid[::columns]:
            axes.set_ylabel("plan accuracy, share of starts")
        for axes in grid[len(shown) :]:
            axes.set_visible(False)
        grid[0].legend(loc="lower right", ncols=2, handlelength=1.4, columnspacing=1.0, fontsize="x-small")
    reached = (f"{panel.title} {max(curve.end[1] for curve in panel.curves):.3f}" for panel in shown)
    return Picture(figure, f"Plan accuracy over training time; the best at the end: {', '.join(reached)}.")


def _draw_panel(axes: Axes, panel: Panel) -> None:
    axes.set_title(panel.title)
    axes.set_xlabel("training time")
    named: set[str] = set()
    for curve in panel.curves:
        method, _, reward = curve.method.partition(":")
        color, line = COLORS.get(method, INK), LINES.get(reward, "-")
        label = None if curve.method in named else curve.method
        named.add(curve.method)
        axes.plot(curve.seconds, curve.accuracies, color=color, ls=line, lw=0.9, alpha=0.7, label=label)
        axes.plot(*curve.end, "o", color=color, ms=3.2, zorder=3)
    top = max(accuracy for curve in panel.curves for accuracy in (*curve.accuracies, curve.end[1]))
    if panel.feasible is not None:
        axes.axhline(panel.feasible, color=MUTED, lw=1.0, ls=(0, (4, 2)))
        axes.annotate(
            f"known feasible {panel.feasible:.3f}",
            (0.02, panel.feasible),
            xycoords=("axes fraction", "data"),
            xytext=(0, 3),
            textcoords="offset points",
            color=MUTED,
        )
        top = max(top, panel.feasible)
    axes.set_xscale("log")
    axes.set_xticks([*TICKS], [*TICKS.values()])
    axes.minorticks_off()
    axes.set_xlim(5.0, 4800.0)
    axes.set_ylim(0, min(1.08, 1.15 * top + 0.01))
