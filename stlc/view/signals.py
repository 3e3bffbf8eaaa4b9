"""Signals and robustness margins over time: figures and animations of traces, and strip charts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.sketch import DECIDED, DECIDERS
from stlc.signature import Column
from stlc.trace import Trace
from stlc.view.animation import Animation
from stlc.view.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    MUTED,
    PAPER,
    RED,
    SKY,
    Picture,
    hide_frame,
    narrow_gaps,
    new_figure,
    picture,
    picture_style,
)
from stlc.view.thinning import extremes
from stlc.view.words import count, labelled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

Floats: TypeAlias = NDArray[np.float64]
Margins: TypeAlias = Mapping[str, Floats]
"""Requirement -> robustness at every sample, (traces, samples), NaN where undefined."""

POLICY, BACKUP, SAFEST, POLISHED = 0, 1, 2, 3
DECISIONS = {
    POLICY: (DECIDERS[POLICY], FAINT),
    **{source: (DECIDERS[source], DECIDED[source]) for source in (BACKUP, SAFEST, POLISHED)},
}
"""Source of a decision -> its word and its colour."""
MOST_LINES = 10
"""Maximum number of panels of numeric signals; signals that change come first."""
MOST_LETTERS = 44
"""Maximum number of characters of a title in one line."""
MOST_ROWS = 7
"""Maximum number of requirements in the strip charts; those with the least margins are shown."""
MOST_PANELS, MOST_AGENTS = 6, 40
"""Maximum numbers of signals and agents in the animation of a trace."""
MARGINS = "smallest robustness over the agents at each instant"
"""Heading of the strip charts."""
GREATEST = 1e300
"""Greatest magnitude that is drawn; differences of greater values are infinite, which Matplotlib refuses."""
_HEIGHTS = {"line": 0.62, "strip": 0.2, "robustness": 0.5, "decision": 0.2}
_COVER = 0.72


def decisions_of(trace: Trace) -> NDArray[np.int64] | None:
    """Source of every decision (policy, or a stage of the guard), (traces, steps); None if not recorded."""
    recorded = trace.extras.get("decision")
    if recorded is None or recorded.ndim != 2 or len(recorded) != trace.traces:
        return None
    return recorded.astype(np.int64)


def acted_in(trace: Trace) -> NDArray[np.int64] | None:
    """Number of interventions of the guard in each trace, (traces,); None if decisions were not recorded."""
    decisions = decisions_of(trace)
    return None if decisions is None else np.asarray((decisions != POLICY).sum(1))


# ---------------------------------------------------------------------- shared by figures and films


def margin_limits(rho: Floats) -> tuple[float, float]:
    """Lower and upper limit of a robustness plot; 0 lies between them.

    Large margins are cut off, so that violations remain visible beside them.
    """
    known = finite(rho)[np.isfinite(rho)]
    if not len(known):
        return -1.0, 1.0
    low, high = min(float(known.min()), 0.0), max(float(np.quantile(known, 0.95)), 0.0)
    if TOLERANCE.satisfied(low):
        low = 0.0  # rounding errors only
    else:
        high = min(high, 4 * -low)
    room = 0.12 * (high - low) or 1.0
    return low - room, high + room


def finite(values: Floats) -> Floats:
    """Values as they are drawn: infinities are replaced by NaN, and others limited to `GREATEST`."""
    return np.where(np.isfinite(values), np.clip(values, -GREATEST, GREATEST), np.nan)


def drawable(trace: Trace) -> Trace:
    """Return a copy of a trace with the values that are drawn."""
    return replace(trace, data={name: finite(values) for name, values in trace.data.items()})


def margin_text(rho: float, unit: str = "") -> str:
    """A margin with its sign, two decimals and unit; "" for NaN."""
    return "" if np.isnan(rho) else f"{rho:+.2f} {unit}".rstrip().replace("-0.00", "+0.00")


def _plot_margin(axes: Axes, times: Floats, rho: Floats) -> None:
    """Draw robustness over time as a step function, blue where positive, red where negative."""
    rho = finite(rho)
    kept = extremes(rho)
    times, rho = times[kept], rho[kept]
    fails = TOLERANCE.violated(rho)
    axes.axhline(0, color=MUTED, lw=0.6)
    axes.fill_between(times, rho, 0, where=~fails, step="post", color=BLUE, alpha=0.2, lw=0)
    axes.fill_between(times, rho, 0, where=fails, step="post", color=RED, alpha=0.35, lw=0)
    axes.step(times, rho, where="post", color=BLUE, lw=1)
    axes.step(times, np.where(fails, rho, np.nan), where="post", color=RED, lw=1.4)


# ---------------------------------------------------------------------------- figures of traces


@dataclass(frozen=True, slots=True)
class Deciding:
    """Value that decides a violation: that of a signal at a sample of a trace.

    Attributes:
        signal: name of the signal.
        trace: number of the trace.
        sample: the sample.
        window: first and last sample of the window in which the value comes closest; None without one.
    """

    signal: str
    trace: int
    sample: int
    window: tuple[int, int] | None


@dataclass(frozen=True, slots=True)
class Marks:
    """Thresholds of requirements, and the values that decide violations.

    Attributes:
        thresholds: signal -> constants with which predicates compare it, in the unit of the signal.
        deciding: values that decide violations, each with its window.
    """

    thresholds: Mapping[str, Sequence[float]] = field(default_factory=dict)
    deciding: Sequence[Deciding] = ()

    def draw(self, axes: Axes, name: str, trace: Trace, index: int) -> None:
        """Mark the panel of the signal `name` of trace number `index`; the limits of the panel are kept."""
        low, high = axes.get_ylim()
        for value in self.thresholds.get(name, ()):
            if 2 * low - high < value < 2 * high - low:  # one that is far away would flatten the signal
                axes.axhline(value, color=MUTED, lw=0.9, ls="--")
        for each in self.deciding:
            if (each.signal, each.trace) == (name, index) and each.sample < trace.samples:
                if each.window is not None:
                    first, last = (min(sample, trace.samples - 1) for sample in each.window)
                    axes.axvspan(trace.times[first], trace.times[last], color=RED, alpha=0.13, lw=0)
                at = each.sample
                axes.plot(trace.times[at], trace.data[name][index][at], "o", color=RED, ms=4)


@dataclass(frozen=True, slots=True)
class Choice:
    """A trace chosen to be drawn.

    Attributes:
        index: number of the trace.
        title: heading, such as `worst: trace 3`.
    """

    index: int
    title: str


def choose_traces(
    least: Floats, names: Sequence[str] = (), acted: NDArray[np.int64] | None = None
) -> tuple[Choice, ...]:
    """Choose the traces to draw: the least robust one, and the one with most interventions of the guard.

    If there are no interventions, the second one is a trace of median robustness. If the first and the second
    are the same trace, it is returned once.

    Args:
        least: robustness per trace, (traces,); NaN if unknown.
        names: names of the traces; default: their numbers.
        acted: number of interventions of the guard in each trace, (traces,).
    """
    order = np.argsort(least, kind="stable")
    worst, other, word = int(order[0]), int(order[max(1, int(np.isfinite(least).sum())) // 2]), "typical"
    if acted is not None and acted.any():
        other, word = int(np.argmax(acted)), f"guard acted most, {count(int(acted.max()), 'time')}"
    called = names or [f"trace {index}" for index in range(len(least))]
    if worst == other:
        return (Choice(worst, called[worst]),)
    first = "worst" if TOLERANCE.violated(least[worst]) else "least robust"
    return Choice(worst, f"{first}: {called[worst]}"), Choice(other, f"{word}: {called[other]}")


def draw_signals(
    trace: Trace,
    margins: Margins,
    choices: Sequence[Choice],
    units: Mapping[str, str] | None = None,
    marks: Marks | None = None,
) -> Picture:
    """Draw a column of panels per chosen trace: signals, decisions, and robustness of each requirement.

    Args:
        trace: the recorded trace.
        margins: requirement -> robustness at every sample, (traces, samples), NaN where undefined.
        choices: the traces to draw.
        units: requirement -> unit of its robustness; it contains only requirements that have a unit.
        marks: thresholds and deciding values, drawn with the signals.
    """
    trace, marks = drawable(trace), marks or Marks()
    rows = _rows(trace, margins)
    heights = [_HEIGHTS[kind] for kind, _ in rows]
    with picture_style():
        figure = new_figure(9, sum(heights) + 0.07 * len(rows) + 0.8)
        narrow_gaps(figure)
        grid = figure.subplots(
            len(rows), len(choices), squeeze=False, sharex=True, sharey="row", height_ratios=heights
        )
        for column, choice in zip(grid.T, choices, strict=True):
            narrow = len(choice.title) <= MOST_LETTERS
            column[0].set_title(choice.title if narrow else choice.title.replace(": ", ":\n", 1), pad=8)
            for axes, (kind, name) in zip(column, rows, strict=True):
                _draw_row(axes, kind, name, trace, margins, choice.index)
                if kind == "line":
                    marks.draw(axes, name, trace, choice.index)
            column[-1].set_xlabel("time [s]")
            column[-1].tick_params(labelbottom=True)
        for axes, (kind, name) in zip(grid[:, 0], rows, strict=True):
            unit = trace.signature[name].unit.text if kind == "line" else (units or {}).get(name, "")
            axes.set_ylabel(picture(labelled(name, unit)), rotation=0, ha="right", va="center", labelpad=6)
            axes.yaxis.set_label_coords(-0.085, 0.5)
        grid[0][0].set_xlim(trace.times[0], trace.times[-1])
        _legend(figure, trace, marks, bool(margins))
    shown = " and ".join(choice.title for choice in choices)
    return Picture(figure, f"Signals, decisions and robustness per requirement; {shown}.")


def left_out(trace: Trace) -> list[str]:
    """Names of the numeric signals that get no panel in the figure."""
    shown = {name for kind, name in _rows(trace, {}) if kind == "line"}
    return [c.name for c in trace.signature.columns if c.kind in ("real", "int") and c.name not in shown]


def _rows(trace: Trace, margins: Margins) -> list[tuple[str, str]]:
    """Return (kind, name) of each panel.

    The order is: numeric signals, discrete signals, decisions, requirements.
    """
    columns = trace.signature.columns
    rows = [("line", c.name) for c in columns if c.kind in ("real", "int")]
    if len(rows) > MOST_LINES:
        rows = [row for row in rows if np.ptp(trace.data[row[1]]) > 0][:MOST_LINES]
    rows += [("strip", c.name) for c in columns if c.kind in ("bool", "enum")]
    if decisions_of(trace) is not None:
        rows.append(("decision", "decision"))
    return rows + [("robustness", name) for name in margins]


def _legend(figure: Figure, trace: Trace, marks: Marks, judged: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    keys = [(BLUE, 0.5, "robustness margin"), (RED, None, "violated")] if judged else []
    decisions = decisions_of(trace)
    for source in sorted(set() if decisions is None else {*np.unique(decisions).tolist()} - {POLICY}):
        word, color = DECISIONS.get(source, ("", MUTED))
        keys.append((color, None, f"{word} decided"))
    handles: list[Artist] = [
        Patch(color=color, alpha=alpha, lw=0, label=label) for color, alpha, label in keys
    ]
    if marks.deciding:
        handles.insert(0, Line2D([], [], color=RED, marker="o", ms=4, lw=0, label="decides the violation"))
        if any(each.window for each in marks.deciding):
            handles.insert(1, Patch(color=RED, alpha=0.13, lw=0, label="its window"))
    if any(marks.thresholds.values()):
        handles.insert(0, Line2D([], [], color=MUTED, lw=0.9, ls="--", label="threshold"))
    if handles:
        figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), handlelength=1.0)


def _draw_row(axes: Axes, kind: str, name: str, trace: Trace, margins: Margins, index: int) -> None:
    """Draw one panel of trace `index`; `kind` selects a signal, the decisions or a robustness.

    Interventions of the guard are shaded behind numeric signals and robustness.
    """
    match kind:
        case "line":
            values = _broken(trace.data[name][index])
            kept = extremes(values)
            axes.plot(trace.times[kept], values[kept], color=INK, lw=1.1)
        case "strip":
            _draw_discrete(axes, trace, trace.data[name][index], trace.signature[name])
        case "robustness":
            rho = margins[name][index]
            _plot_margin(axes, trace.times[: len(rho)], rho)
            axes.set_ylim(*margin_limits(margins[name]))
    if kind in ("line", "robustness"):
        axes.locator_params(axis="y", nbins=3)
    else:
        axes.set_ylim(0, 1)
        hide_frame(axes)
    decisions = None if kind == "strip" else decisions_of(trace)
    for left, right, source in [] if decisions is None else _stretches(trace, decisions[index]):
        if kind == "decision" or source != POLICY:
            _, color = DECISIONS.get(source, ("", MUTED))
            axes.axvspan(left, right, color=color, alpha=1 if kind == "decision" else 0.13, lw=0)


def _broken(values: Floats) -> Floats:
    """Return a signal with NaN at its jumps (such as resets), so that no line is drawn across them.

    A single sample far from both its neighbours is no jump, and stays. A signal that changes mainly by large
    steps is returned unchanged.
    """
    steps = np.abs(np.diff(values))
    moves = steps[steps > 0]
    span = float(np.ptp(values))
    if not len(moves) or np.median(moves) > 0.3 * span:
        return values
    large = np.pad(steps > 0.4 * span, 1)
    broken = values.copy()
    broken[1:][large[1:-1] & ~large[:-2] & ~large[2:]] = np.nan
    return broken


def _draw_discrete(axes: Axes, trace: Trace, values: Floats, column: Column) -> None:
    labels = {value: label for label, value in column.labels} or {0.0: "", 1.0: "yes"}
    levels = sorted({*labels, *np.unique(values[np.isfinite(values)]).tolist()})
    tints = (FAINT, SKY, MUTED, BLUE, GREEN)
    for left, right, value in _stretches(trace, values):
        axes.axvspan(left, right, color=tints[levels.index(value) % len(tints)], alpha=0.75, lw=0)
        label = labels.get(value, f"{value:g}")
        if label and (right - left) > 0.08 * trace.dt * trace.samples:
            axes.text((left + right) / 2, 0.5, label, ha="center", va="center", fontsize=7, color=INK)


def _stretches(trace: Trace, values: NDArray[Any]) -> Iterator[tuple[float, float, Any]]:
    """Yield the stretches in which `values`, one a sample, is constant, as (begin, end, value)."""
    kept = extremes(values.astype(np.float64))
    edges = np.append(trace.times[kept], trace.times[-1] + trace.dt)
    for start, stop, value in constant_ranges(values[kept]):
        yield float(edges[start]), float(edges[stop]), value


def constant_ranges(values: NDArray[Any]) -> list[tuple[int, int, Any]]:
    """Return the ranges in which `values` is constant, as triples (start, stop, value)."""
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    return [(a, b, values[a].item()) for a, b in pairwise(edges) if b > a]


# ------------------------------------------------------------------------------ strip charts of films


@dataclass(frozen=True, slots=True)
class Strip:
    """Strip charts below an animation: least robustness of each requirement, and interventions of the guard.

    Attributes:
        times: times of the frames in seconds, (frames,).
        margins: requirement -> least robustness over the agents, (frames,); see `verdicts.margins_of`.
        decisions: source of each decision, (frames, agents); None if not recorded.
        units: requirement -> unit of its margin; it contains only requirements that have a unit.
    """

    times: Floats
    margins: Mapping[str, Floats]
    decisions: NDArray[np.int64] | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def rows(self) -> list[str]:
        """Names of the requirements that get a strip chart.

        These are the requirements with the least margins, at most `MOST_ROWS`.
        """
        known = [name for name, rho in self.margins.items() if np.isfinite(rho).any()]
        least = sorted(known, key=lambda name: float(np.nanmin(finite(self.margins[name]))))[:MOST_ROWS]
        return [name for name in known if name in least]

    @property
    def height(self) -> int:
        """Number of strip charts, including the chart of interventions."""
        return len(self.rows) + bool(self.acted.any())

    @property
    def acted(self) -> NDArray[np.int64]:
        """Number of agents for which the guard intervened, (frames,)."""
        if self.decisions is None:
            return np.zeros(len(self.times), dtype=np.int64)
        return np.asarray((self.decisions > 0).sum(1))

    def stacked(self) -> Iterator[tuple[str, Floats, Floats]]:
        """Yield one band per source of interventions, stacked: colour, lower edge, and upper edge.

        The edges are numbers of agents, (frames,).
        """
        base = np.zeros(len(self.times))
        for source, color in enumerate(DECIDED[1:], start=1):
            more = base + (0 if self.decisions is None else (self.decisions == source).sum(1))
            if (more > base).any():
                yield color, base, more
            base = more


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """Drawn objects (artists) that change from frame to frame.

    Attributes:
        turn: function that changes the artists to show the frame of a given index.
        artists: the artists.
    """

    turn: Callable[[int], None]
    artists: tuple[Artist, ...]


def draw_strip(strip: Strip, panels: list[Axes]) -> list[FrameUpdate]:
    """Draw the strip charts, one per panel; return the parts that change from frame to frame."""
    updates: list[FrameUpdate] = []
    free = list(panels)
    if strip.acted.any():
        updates.append(_draw_interventions(strip, free.pop(0)))
    updates += [_draw_margin(strip, name, axes) for name, axes in zip(strip.rows, free, strict=True)]
    for axes in panels:
        updates.append(_cover_future(axes, strip.times))
        axes.grid(visible=False)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.spines["bottom"].set_visible(axes is panels[-1])
        axes.tick_params(labelbottom=axes is panels[-1])
    panels[-1].set_xlabel("time [s]", color=MUTED, fontsize=7.5, labelpad=1)
    return updates


def _draw_interventions(strip: Strip, axes: Axes) -> FrameUpdate:
    assert strip.decisions is not None
    agents = strip.decisions.shape[1]
    for color, low, high in strip.stacked():
        axes.fill_between(strip.times, low, high, step="post", color=color, lw=0)
    axes.set_ylim(0, max(float(strip.acted.max()), 0.25 * agents) * 1.05)
    value = _titled(axes, "guard acted")

    def turn(index: int) -> None:
        count = int(strip.acted[index])
        value.set_text(f"{count} of {agents}")
        value.set_color(INK if count else MUTED)

    return FrameUpdate(turn, (value,))


def _draw_margin(strip: Strip, name: str, axes: Axes) -> FrameUpdate:
    rho = finite(strip.margins[name])
    _plot_margin(axes, strip.times, rho)
    axes.set_ylim(*margin_limits(rho))
    value = _titled(axes, name)

    def turn(index: int) -> None:
        now = float(rho[index])
        value.set_text(margin_text(now, strip.units.get(name, "")))
        value.set_color(RED if TOLERANCE.violated(now) else INK)

    return FrameUpdate(turn, (value,))


def _titled(axes: Axes, name: str) -> Text:
    """Write the name of a chart on its left.

    Returns the text on the right of the chart, which is to show the present value.
    """
    axes.axhspan(*axes.get_ylim(), color=FAINT, alpha=0.25, lw=0, zorder=0)
    beside: Any = {"transform": axes.transAxes, "va": "center", "fontsize": 8, "color": INK}
    axes.text(-0.012, 0.5, picture(name), ha="right", **beside)
    return axes.text(1.01, 0.5, "", ha="left", **beside)


def _cover_future(axes: Axes, times: Floats) -> FrameUpdate:
    """Cover the times after the present frame, and draw a line at the present time.

    Returns an object that moves the cover and the line to another frame.
    """
    from matplotlib.patches import Rectangle

    axes.set_xlim(float(times[0]), float(times[-1]))
    transform = axes.get_xaxis_transform()
    cover = Rectangle((0, 0), 0, 1, transform=transform, color=PAPER, alpha=_COVER, lw=0, zorder=4)
    axes.add_patch(cover)
    present = axes.axvline(float(times[0]), color=INK, lw=1, zorder=5)

    def turn(index: int) -> None:
        now = float(times[index])
        cover.set_bounds(now, 0, float(times[-1]) - now, 1)
        present.set_xdata([now, now])

    return FrameUpdate(turn, (cover, present))


# ---------------------------------------------------------------------------- animation of a trace


def signal_animation(trace: Trace, *, title: str = "") -> Animation:
    """Animation of the signals of a trace: one panel per signal, with all agents.

    It is used for a run without a drawing of its world.
    """
    trace = drawable(trace)
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
    return Animation(trace.samples, trace.dt, (6.4, height), begin, alt, trace.samples - 1)


def _panel(axes: Axes, trace: Trace, name: str) -> Callable[[int], None]:
    """Draw a signal of at most `MOST_AGENTS` agents.

    Returns a function that changes the drawing to show the frame of a given index.
    """
    values = trace.data[name][:MOST_AGENTS]
    gap = np.full((len(values), 1), np.nan)
    axes.set_ylabel(labelled(name, trace.signature[name].unit.text).replace(" [", "\n[", 1))
    times = np.broadcast_to(trace.times, values.shape)
    axes.plot(np.hstack([times, gap]).ravel(), np.hstack([values, gap]).ravel(), color=INK, lw=0.8, alpha=0.7)
    (present,) = axes.plot([], [], "o", color=BLUE, ms=3, zorder=5)
    cover = _cover_future(axes, trace.times)

    def turn(index: int) -> None:
        present.set_data(times[:, index], values[:, index])
        cover.turn(index)

    return turn
