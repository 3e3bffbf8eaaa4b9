"""How training went: accuracy, requirements, loss and learning rate over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stlc.view.style import BLUE, INK, MUTED, SERIES, Picture, look, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Rows = Sequence[Mapping[str, Any]]


def draw_curves(rows: Rows) -> Picture | None:
    """The curves of the rows of `train.jsonl`; None where nothing was measured yet."""
    measured = [row for row in rows if row.get("accuracy") is not None]
    if len(measured) < 2:
        return None
    with look():
        figure = new_figure(9, 3.2)
        left, middle, right = figure.subplots(1, 3, width_ratios=[1.35, 1.35, 1])
        _draw_accuracy(left, measured)
        _draw_requirements(middle, measured)
        _draw_loss(right, rows)
        for axes in (left, middle, right):
            axes.set_xlabel("training time [s]")
            axes.margins(x=0.01)
    first, last = measured[0], measured[-1]
    course = f"from {first['accuracy']:.3f} to {last['accuracy']:.3f} in {last['seconds']:.0f} s"
    alt = f"Plan accuracy while training, {course}."
    return Picture(figure, alt)


def _column(rows: Rows, key: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Seconds and values of the rows that have `key`."""
    kept = [row for row in rows if row.get(key) is not None]
    return (
        np.array([float(row["seconds"]) for row in kept]),
        np.array([float(row[key]) for row in kept]),
    )


def _set_share_axis(axes: Axes, values: NDArray[np.float64]) -> None:
    """Down to the bulk of `values`: the first measurements of a run may fall below the axis."""
    floor = float(np.quantile(values, 0.08)) if len(values) else 0.0
    low = max(0.0, np.floor(20 * (floor - 0.02)) / 20)
    axes.set_ylim(low, 1.0 + 0.012 * (1 - low))


def _draw_accuracy(axes: Axes, rows: Rows) -> None:
    axes.set_title("plan accuracy")
    seconds, accuracy = _column(rows, "accuracy")
    axes.plot(seconds, accuracy, color=BLUE, lw=1.8, zorder=3)
    axes.plot(seconds[-1], accuracy[-1], "o", color=BLUE, ms=4, zorder=4)
    axes.annotate(
        f"{accuracy[-1]:.3f}",
        (seconds[-1], accuracy[-1]),
        xytext=(0, -20),
        textcoords="offset points",
        ha="right",
        color=BLUE,
        weight="bold",
    )
    known, feasible = _column(rows, "feasible")
    if len(feasible):
        axes.plot(known, feasible, color=MUTED, lw=1.1, ls=(0, (4, 2)))
        axes.annotate(
            f"known feasible {feasible[-1]:.3f}",
            (known[-1], feasible[-1]),
            xytext=(0, 5),
            textcoords="offset points",
            ha="right",
            color=MUTED,
        )
    _set_share_axis(axes, accuracy)


def _draw_requirements(axes: Axes, rows: Rows) -> None:
    axes.set_title("per requirement")
    names = list(dict.fromkeys(name for row in rows for name in (row.get("requirements") or {})))
    everything = []
    for index, name in enumerate(names):
        kept = [row for row in rows if name in (row.get("requirements") or {})]
        shares = np.array([float(row["requirements"][name]) for row in kept])
        everything.append(shares)
        color = SERIES[index % len(SERIES)]
        label = f"{name}  {shares[-1]:.3f}"
        style = "-" if index < len(SERIES) else "--"
        axes.plot([float(row["seconds"]) for row in kept], shares, style, color=color, label=label)
    if everything:
        _set_share_axis(axes, np.concatenate(everything))
        axes.legend(loc="lower right", handlelength=1.2, labelcolor=INK)


def _draw_loss(axes: Axes, rows: Rows) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.set_title("loss")
    seconds, loss = _column(rows, "loss")
    if len(loss):
        axes.plot(seconds, loss, color=INK, lw=1.2)
        if loss.min() > 0 and loss.max() > 5 * loss.min():
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
    seconds, rate = _column(rows, "lr")
    if not len(rate) or rate.max() <= 0:
        return
    twin = axes.twinx()
    twin.fill_between(seconds, rate, color=MUTED, alpha=0.14, lw=0)
    twin.annotate(
        f"learning rate, at most {rate.max():.1e}",
        (1, 1),
        xycoords="axes fraction",
        xytext=(0, 3),
        textcoords="offset points",
        ha="right",
        color=MUTED,
        fontsize=7.5,
    )
    twin.set_ylim(0, 1.08 * float(rate.max()))
    twin.set_yticks([])
    twin.spines["right"].set_visible(False)
