"""The strip beneath a scene: the least margin of each requirement over time, and when the backup acted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.sketch import DECIDED
from stlc.escape import picture
from stlc.view.signals import margin_limits
from stlc.view.style import BLUE, FAINT, INK, MUTED, PAPER, RED

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.text import Text

MOST_ROWS = 7
"""Requirements that are shown, those with the least margin first."""
_VEILED = 0.72


@dataclass(frozen=True, slots=True)
class Strip:
    """What is drawn over time.

    Attributes:
        times: of the frames, in seconds, (frames,).
        margins: requirement -> the least robustness of all agents from each start on, (frames,); NaN where
            it is not known.
        decisions: who decided, (frames, agents); None where nobody recorded it.
        words: what the margins are.
        units: requirement -> that of its margin, where it has one.
    """

    times: NDArray[np.float64]
    margins: Mapping[str, NDArray[np.float64]]
    decisions: NDArray[np.int64] | None = None
    words: str = "least margin of all agents, from each instant on"
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def rows(self) -> list[str]:
        """Names of the requirements that are shown, in their order."""
        known = [name for name, rho in self.margins.items() if np.isfinite(rho).any()]
        least = sorted(known, key=lambda name: float(np.nanmin(_finite(self.margins[name]))))[:MOST_ROWS]
        return [name for name in known if name in least]

    @property
    def height(self) -> int:
        """Rows that it takes."""
        return len(self.rows) + bool(self.acted.any())

    @property
    def acted(self) -> NDArray[np.int64]:
        """How many agents something else than the policy decided for, (frames,)."""
        if self.decisions is None:
            return np.zeros(len(self.times), dtype=np.int64)
        return np.asarray((self.decisions > 0).sum(1))


@dataclass(frozen=True, slots=True)
class Mover:
    """What turns something to a frame, and what of the picture changes then."""

    turn: Callable[[int], None]
    artists: tuple[Artist, ...]


def draw_strip(strip: Strip, panels: list[Axes]) -> list[Mover]:
    """Draw `strip` into its panels, one a row; returns what moves in them."""
    movers: list[Mover] = []
    free = list(panels)
    if strip.acted.any():
        movers.append(_draw_decisions(strip, free.pop(0)))
    movers += [_draw_margin(strip, name, axes) for name, axes in zip(strip.rows, free, strict=True)]
    for axes in panels:
        movers.append(veil(axes, strip.times))
        axes.grid(visible=False)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.spines["bottom"].set_visible(axes is panels[-1])
        axes.tick_params(labelbottom=axes is panels[-1])
    panels[-1].set_xlabel("time [s]", color=MUTED, fontsize=7.5, labelpad=1)
    return movers


def _draw_decisions(strip: Strip, axes: Axes) -> Mover:
    """Agents stacked by who decided for them, the policy left out."""
    assert strip.decisions is not None
    agents = strip.decisions.shape[1]
    base = np.zeros(len(strip.times))
    for source, color in enumerate(DECIDED[1:], start=1):
        count = (strip.decisions == source).sum(1)
        if count.any():
            axes.fill_between(strip.times, base, base + count, step="post", color=color, lw=0)
        base = base + count
    axes.set_ylim(0, max(float(base.max()), 0.25 * agents) * 1.05)
    _name(axes, "guard acted")
    value = _value(axes)

    def turn(index: int) -> None:
        count = int(strip.acted[index])
        value.set_text(f"{count} of {agents}")
        value.set_color(INK if count else MUTED)

    return Mover(turn, (value,))


def _draw_margin(strip: Strip, name: str, axes: Axes) -> Mover:
    rho = _finite(strip.margins[name])
    fails = rho < -TOLERANCE
    axes.axhline(0, color=MUTED, lw=0.6)
    axes.fill_between(strip.times, rho, 0, where=~fails, step="post", color=BLUE, alpha=0.22, lw=0)
    axes.fill_between(strip.times, rho, 0, where=fails, step="post", color=RED, alpha=0.4, lw=0)
    axes.step(strip.times, rho, where="post", color=BLUE, lw=1)
    axes.step(strip.times, np.where(fails, rho, np.nan), where="post", color=RED, lw=1.4)
    axes.set_ylim(*margin_limits(rho))
    _name(axes, name)
    value = _value(axes)
    unit = f" {strip.units[name]}" if strip.units.get(name) else ""

    def turn(index: int) -> None:
        now = float(rho[index])
        value.set_text("" if np.isnan(now) else f"{now:+.2f}{unit}".replace("-0.00", "+0.00"))
        value.set_color(RED if now < -TOLERANCE else INK)

    return Mover(turn, (value,))


def veil(axes: Axes, times: NDArray[np.float64]) -> Mover:
    """What has not happened yet shows faintly behind the present."""
    from matplotlib.patches import Rectangle

    axes.set_xlim(float(times[0]), float(times[-1]))
    transform = axes.get_xaxis_transform()
    cover = Rectangle((0, 0), 0, 1, transform=transform, color=PAPER, alpha=_VEILED, lw=0, zorder=4)
    axes.add_patch(cover)
    present = axes.axvline(float(times[0]), color=INK, lw=1, zorder=5)

    def turn(index: int) -> None:
        now = float(times[index])
        cover.set_bounds(now, 0, float(times[-1]) - now, 1)
        present.set_xdata([now, now])

    return Mover(turn, (cover, present))


def _name(axes: Axes, name: str) -> None:
    axes.axhspan(*axes.get_ylim(), color=FAINT, alpha=0.25, lw=0, zorder=0)
    label = picture(name)
    axes.text(-0.012, 0.5, label, transform=axes.transAxes, ha="right", va="center", fontsize=8, color=INK)


def _value(axes: Axes) -> Text:
    return axes.text(1.01, 0.5, "", transform=axes.transAxes, ha="left", va="center", fontsize=8, color=INK)


def _finite(rho: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(rho), rho, np.nan)
