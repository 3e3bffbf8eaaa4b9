"""Where in the initial set the policy fails, drawn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.escape import picture
from stlc.signature import Signature
from stlc.view.held_out import (
    Condition,
    HeldOut,
    Weakness,
    find_weakness,
    region_text,
    weakness_text,
)
from stlc.view.style import BLUE, INK, MUTED, RED, Picture, look, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_failures(
    held: HeldOut, signature: Signature | None = None, units: Mapping[str, str] | None = None
) -> Picture | None:
    """The worst requirement over the two columns that tell most; None if nothing fails.

    Args:
        held: starts and how their plans fared.
        signature: of the system, for units and labels of states.
        units: requirement -> that of its robustness, where it has one.
    """
    weakness = find_weakness(held)
    if weakness is None:
        return None
    with look():
        figure = new_figure(9, 3.4)
        left, right = figure.subplots(1, 2, width_ratios=[1.6, 1])
        _draw_starts(left, held, weakness, signature)
        _draw_margins(right, held, weakness, units or {})
    name = held.requirements[weakness.requirement]
    return Picture(figure, f"{name} {weakness_text(weakness, held, signature)}.")


def _draw_starts(axes: Axes, held: HeldOut, weakness: Weakness, signature: Signature | None) -> None:
    labels = tuple(condition for condition in weakness.conditions if condition.op == "=")
    shown = np.ones(len(held.x0), dtype=bool)
    for condition in labels:
        shown &= condition.holds(held.x0)
    failing = held.each[:, weakness.requirement] < -TOLERANCE
    name = held.requirements[weakness.requirement]
    where = region_text(labels, held.names, signature)
    axes.set_title(f"starts with {where}" if where else "all held-out starts")
    a, b = weakness.axes
    kinds = [(shown & ~failing, BLUE, 5, "satisfied")]
    if held.known is None:
        kinds.append((shown & failing, RED, 9, f"{name} fails"))
    else:
        kinds.append((shown & failing & ~held.known, MUTED, 7, "no plan is known"))
        kinds.append((shown & failing & held.known, RED, 9, f"{name} fails"))
    kinds = [kind for kind in kinds if kind[0].any()]
    for mask, color, size, label in kinds:
        axes.scatter(
            held.x0[mask, a],
            held.x0[mask, b],
            s=size,
            color=color,
            alpha=0.28 if color == BLUE else 0.8,
            lw=0,
            label=picture(f"{label} ({int(mask.sum()):,})"),
            rasterized=True,
        )
    _draw_region(axes, weakness, held.x0[shown])
    axes.set_xlabel(_label(held.names[a], signature))
    axes.set_ylabel(_label(held.names[b], signature))
    axes.margins(0.02)
    legend = axes.legend(
        loc="upper left", bbox_to_anchor=(-0.02, -0.14), ncols=len(kinds), handletextpad=0.1, markerscale=1.6
    )
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1)


def _draw_region(axes: Axes, weakness: Weakness, x0: NDArray[np.float64]) -> None:
    """Outline the region's box in the two drawn columns."""
    from matplotlib.patches import Rectangle

    if len(x0) == 0 or not any(c.column in weakness.axes and c.op != "=" for c in weakness.conditions):
        return
    (left, right), (low, high) = (_extent(weakness.conditions, c, x0) for c in weakness.axes)
    axes.add_patch(Rectangle((left, low), right - left, high - low, fill=False, ec=INK, lw=1, ls=(0, (4, 2))))


def _extent(conditions: tuple[Condition, ...], column: int, x0: NDArray[np.float64]) -> tuple[float, float]:
    low, high = float(x0[:, column].min()), float(x0[:, column].max())
    for condition in conditions:
        if condition.column == column and condition.op == ">=":
            low = max(low, condition.value)
        if condition.column == column and condition.op == "<=":
            high = min(high, condition.value)
    return low, high


def _draw_margins(axes: Axes, held: HeldOut, weakness: Weakness, units: Mapping[str, str]) -> None:
    from matplotlib.ticker import StrMethodFormatter

    name = held.requirements[weakness.requirement]
    rho = held.each[:, weakness.requirement]
    rho = rho[np.isfinite(rho)]
    low, high = np.quantile(rho, [0.002, 0.998])
    edges = np.linspace(min(low, -1e-3), max(high, 1e-3), 46)
    edges = np.sort(np.append(edges, -TOLERANCE))
    bins = edges.tolist()
    clipped = np.clip(rho, edges[0], edges[-1])
    for mask, color in ((rho >= -TOLERANCE, BLUE), (rho < -TOLERANCE, RED)):
        axes.hist(clipped[mask], bins=bins, color=color, alpha=0.85)
    axes.axvline(0, color=INK, lw=0.8)
    axes.set_yscale("symlog", linthresh=10)
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_title(picture(f"robustness of {name}"))
    unit = f" [{units[name]}]" if units.get(name) else ""
    axes.set_xlabel(f"robustness of the plan{unit}")
    axes.set_ylabel("starts", color=MUTED)
    axes.grid(visible=False, axis="x")


def _label(name: str, signature: Signature | None) -> str:
    if signature is None or name not in signature:
        return name
    unit = signature[name].unit.text
    return f"{name} [{unit}]" if unit not in ("", "1") else name
