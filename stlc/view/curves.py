"""Learning curves: plan accuracy, accuracy per requirement, loss and learning rate over training time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stlc.view.style import BLUE, INK, MUTED, SERIES, Picture, new_figure, picture, picture_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Rows = Sequence[Mapping[str, Any]]


def draw_curves(rows: Rows) -> Picture | None:
    """Draw learning curves from the rows of `train.jsonl`.

    Returns None if the accuracy was measured less than twice.
    """
    rows = [row for row in rows if row.get("seconds") is not None]
    measured = [row for row in rows if row.get("accuracy") is not None]
    if len(measured) < 2:
        return None
    with picture_style():
        figure = new_figure(9, 3.4)
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
    """Times in seconds and values of the rows of `train.jsonl` that have `key`."""
    pairs = [(float(row["seconds"]), float(row[key])) for row in rows if row.get(key) is not None]
    seconds, values = np.array(pairs).reshape(-1, 2).T
    return seconds, values


def _smoothed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moving average of `values`.

    The averaging window contains 1/30 of the values; it is shorter at both ends.
    """
    window = np.ones(2 * (len(values) // 60) + 1)
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")


def _set_share_axis(axes: Axes, values: Sequence[NDArray[np.float64]]) -> None:
    """Set vertical limits that show all of the highest curve and most of the lowest.

    The first points of the lowest curve may be cut off.
    """
    low = min((float(np.quantile(curve, 0.08)) for curve in values if len(curve)), default=0.0)
    high = max((float(curve.max()) for curve in values if len(curve)), default=1.0)
    low = max(0.0, np.floor(20 * (low - 0.02)) / 20)
    high = max(min(1.0, np.ceil(20 * high) / 20), low + 0.05)
    axes.set_ylim(low, high + 0.012 * (high - low))


def _draw_share(axes: Axes, seconds: NDArray[np.float64], shares: NDArray[np.float64], **style: Any) -> None:
    """Draw a curve of measured shares as a faint line, and its moving average as a clear line on top.

    `seconds` are the times of the measurements. `style` holds arguments of `Axes.plot` for the clear line.
    """
    axes.plot(seconds, shares, **{**style, "label": None, "alpha": 0.28, "lw": 0.8})
    axes.plot(seconds, _smoothed(shares), **style)


def _legend(axes: Axes, rows: int) -> None:
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(-0.02, -0.17),
        ncols=-(-len(axes.get_legend_handles_labels()[1]) // rows),
        handlelength=1.2,
        columnspacing=1.2,
        borderaxespad=0,
        labelcolor=INK,
    )


def _draw_accuracy(axes: Axes, rows: Rows) -> None:
    axes.set_title("plan accuracy")
    axes.set_ylabel("share of starts")
    seconds, accuracy = _column(rows, "accuracy")
    label = f"policy  {_smoothed(accuracy)[-1]:.3f}"
    _draw_share(axes, seconds, accuracy, color=BLUE, lw=1.8, zorder=3, label=label)
    known, feasible = _column(rows, "feasible")
    if len(feasible):
        label = f"known feasible  {_smoothed(feasible)[-1]:.3f}"
        _draw_share(axes, known, feasible, color=MUTED, lw=1.2, ls=(0, (4, 2)), label=label)
    _set_share_axis(axes, [accuracy, feasible])
    _legend(axes, 2)


def _draw_requirements(axes: Axes, rows: Rows) -> None:
    axes.set_title("per requirement")
    shares_of = [(row["seconds"], row.get("requirements") or {}) for row in rows]
    names = list(dict.fromkeys(name for _, shares in shares_of for name in shares))
    everything = []
    for index, name in enumerate(names):
        own = [{"seconds": seconds, "share": shares.get(name)} for seconds, shares in shares_of]
        seconds, shares = _column(own, "share")
        everything.append(shares)
        color, style = SERIES[index % len(SERIES)], "-" if index < len(SERIES) else "--"
        label = picture(f"{name}  {_smoothed(shares)[-1]:.3f}")
        _draw_share(axes, seconds, shares, color=color, ls=style, label=label)
    if everything:
        _set_share_axis(axes, everything)
        _legend(axes, 3)


def _draw_loss(axes: Axes, rows: Rows) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.set_title("loss")
    seconds, loss = _column(rows, "loss")
    if len(loss):
        axes.plot(seconds, loss, color=INK, lw=0.7, alpha=0.3)
        axes.plot(seconds, _smoothed(loss), color=INK, lw=1.2)
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
    text = f"learning rate, at most {rate.max():.1e}"
    twin.set_title(text, loc="right", pad=3, color=MUTED, fontsize=7.5, weight="normal")
    twin.set_ylim(0, 1.08 * float(rate.max()))
    twin.set_yticks([])
    twin.spines["right"].set_visible(False)
