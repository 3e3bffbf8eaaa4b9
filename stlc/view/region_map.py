"""Map of a trace: the regions that the specification names, and the paths of the traces.

Beside the map, the share of traces in each region is shown over time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import typed
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import StlcError
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.monitor.judgement import Verdict
from stlc.monitor.verdict import Monitor
from stlc.signature import Signature
from stlc.source import Span
from stlc.trace import Trace
from stlc.view.animation import Animation
from stlc.view.signals import MOST_AGENTS, drawable
from stlc.view.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PINK,
    RED,
    SKY,
    Picture,
    new_figure,
    picture_style,
)
from stlc.view.thinning import extremes
from stlc.view.words import labelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch


MOST_PATHS = 200
"""Maximum number of drawn paths; violating ones come first."""
CROWDED = 1000
"""Number of path points above which thinner lines are drawn."""
TAIL = 2.5
"""Length of the trail behind an agent in the animation, in seconds."""
STRONG, FEEBLE = 0.4, 0.1
"""Opacity of a region while it is active, and while it is not."""
_TINTS = (GREEN, BLUE, PINK, SKY, ORANGE)

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RegionMap:
    """Paths of a trace and regions of its specification, as drawn in a map.

    Attributes:
        trace: the recorded trace.
        plane: the two signals on the axes, and their regions.
        violated: whether a trace violates any requirement, (traces,).
    """

    trace: Trace
    plane: Plane
    violated: Mask

    @property
    def paths(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Horizontal and vertical coordinates of the paths, (traces, samples) each."""
        across, up = self.plane.axes
        return self.trace.data[across], self.trace.data[up]

    def color(self, region: MapRegion) -> str:
        """Colour of a region: red if it must be avoided, else a colour assigned to it."""
        if region.role == "avoid":
            return RED
        others = [other for other in self.plane.regions if other.role != "avoid"]
        return _TINTS[others.index(region) % len(_TINTS)]

    def inside(self, region: MapRegion) -> Mask:
        """Return for every trace and sample whether it is inside a region, (traces, samples)."""
        return region.depth(self.trace) >= 0.0

    def first(self, most: int) -> NDArray[np.int64]:
        """Return the indices of the traces to draw, at most `most`; traces with violations come first."""
        return np.argsort(~self.violated, kind="stable")[:most]


def map_of(spec: Spec, verdict: Verdict, trace: Trace, violated: Mask | None = None) -> RegionMap | None:
    """The map of an evaluated trace; None if its specification names no planar regions.

    `violated`: the traces to be drawn as violated, (traces,); by default those that `verdict` violates.
    """
    plane = plane_of(spec, [judgement.rule for judgement in verdict], trace)
    if plane is None:
        return None
    if violated is None:
        violated = np.logical_or.reduce([judgement.fails.any(0) for judgement in verdict])
    return RegionMap(drawable(trace), plane, violated)


def draw_map(region_map: RegionMap) -> Picture:
    """Draw all paths over the regions, and beside them the share of traces in each region over time."""
    with picture_style():
        figure = new_figure(9, 4.4)
        plot, rows = _layout(figure, region_map)
        _draw_regions(plot, region_map)
        _draw_paths(plot, region_map)
        for axes, region in zip(rows, region_map.plane.regions, strict=True):
            _draw_presence(axes, region_map, region)
    return Picture(figure, f"{_summary(region_map)}, over the regions of the specification.")


def map_animation(region_map: RegionMap, *, title: str = "") -> Animation:
    """Animation of the map: agents leave fading trails, and a region is filled while it is active.

    A region is active during the time windows of the requirements that refer to it.
    """

    def begin(figure: Figure) -> Callable[[int], None]:
        plot, rows = _layout(figure, region_map)
        areas = _draw_regions(plot, region_map)
        moving = _MovingAgents(plot, region_map)
        cursors = []
        for axes, region in zip(rows, region_map.plane.regions, strict=True):
            _draw_presence(axes, region_map, region)
            cursors.append(axes.axvline(region_map.trace.t0, color=INK, lw=1.1))
        head = plot.set_title(_heading(title, region_map.trace.times[-1]))
        figure.draw_without_rendering()
        figure.set_layout_engine("none")

        def turn(index: int) -> None:
            now = float(region_map.trace.times[index])
            head.set_text(_heading(title, now))
            moving.turn(index)
            for region, area in zip(region_map.plane.regions, areas, strict=True):
                strength = STRONG if region.active(now - region_map.trace.t0) else FEEBLE
                area.set_facecolor((region_map.color(region), strength))
            for cursor in cursors:
                cursor.set_xdata([now, now])

        return turn

    alt = f"{title}: {_summary(region_map)}, in motion over the regions of the specification."
    return Animation(
        region_map.trace.samples, region_map.trace.dt, (8.4, 4.1), begin, alt, region_map.trace.samples // 2
    )


def _heading(title: str, seconds: float) -> str:
    return f"{title}   {seconds:4.1f} s".strip()


def _summary(region_map: RegionMap) -> str:
    good = int((~region_map.violated).sum())
    return f"Paths of {len(region_map.violated):,} traces, {good:,} of which satisfy every requirement"


# ---------------------------------------------------------------------- pieces


def _layout(figure: Figure, region_map: RegionMap) -> tuple[Axes, list[Axes]]:
    """Return the axes of the map, and the list of axes beside the map.

    The list contains one entry per region, from top to bottom.
    """
    (left, right), (low, high) = region_map.plane.window(region_map.trace)
    ratio = min(max((right - left) / (high - low), 0.6), 2.0)
    grid = figure.add_gridspec(1, 2, width_ratios=[1.55 * ratio**0.5, 1])
    plot = figure.add_subplot(grid[0])
    plot.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    across, up = (
        labelled(name, region_map.trace.signature[name].unit.text) for name in region_map.plane.axes
    )
    plot.set(xlabel=across, ylabel=up)
    beside = grid[1].subgridspec(len(region_map.plane.regions), 1)
    rows = beside.subplots(sharex=True, squeeze=False)[:, 0].tolist()
    rows[-1].set_xlabel("time [s]")
    return plot, rows


def _draw_regions(axes: Axes, region_map: RegionMap) -> list[PathPatch]:
    """Draw every region; return one filled patch per region.

    The patch is empty if the region is outside of the picture.
    """
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    window = (axes.get_xlim(), axes.get_ylim())
    areas, regions = [], region_map.plane.regions
    sampled = [region_map.plane.sampled(region, region_map.trace, window) for region in regions]
    for index, (region, (xs, ys, depth)) in enumerate(zip(regions, sampled, strict=True)):
        color = region_map.color(region)
        outline = Path(np.empty((0, 2)))
        if (depth >= 0).any():
            filled = axes.contourf(xs, ys, depth, levels=[0, 2 * max(float(depth.max()), 1e-9)])
            outline = filled.get_paths()[0]
            filled.remove()
            others = [other for k, (_, _, other) in enumerate(sampled) if k != index]
            row, column = _clearest(depth, others)
            paper = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.7}
            bold: Any = {"ha": "center", "va": "center", "color": INK, "weight": "bold", "zorder": 6}
            axes.annotate(region.title, (xs[column], ys[row]), bbox=paper, **bold)
        area = PathPatch(outline, fc=(color, STRONG), ec=color, lw=1.2, zorder=2)
        if region.role == "avoid":
            area.set_hatch("///")
        axes.add_patch(area)
        areas.append(area)
    return areas


def _clearest(depth: NDArray[np.float64], others: Sequence[NDArray[np.float64]]) -> tuple[int, int]:
    """Grid position (row, column) for the label of a region: deep inside, if possible outside of the others.

    `depth`, `others`: signed distance of each grid point to the border of a region, positive inside.
    """
    free = np.minimum.reduce([depth, *(-other for other in others)])
    row, column = np.unravel_index(np.argmax(free if (free >= 0).any() else depth), depth.shape)
    return int(row), int(column)


def _draw_paths(axes: Axes, region_map: RegionMap) -> None:
    """Draw satisfying paths in the text colour, violating ones above them in red; mark starts and ends."""
    across, up = region_map.paths
    chosen = region_map.first(MOST_PATHS)
    for violated, color, order in ((False, INK, 3), (True, RED, 4)):
        rows = chosen[region_map.violated[chosen] == violated]
        if not len(rows):
            continue
        strength = max(0.25, 0.9 - 0.01 * len(rows))
        width = 0.7 if across[rows].size < CROWDED else 0.45
        xs, ys = _joined(across[rows], up[rows])
        count = int((region_map.violated == violated).sum())
        word = "violated" if violated else "satisfied"
        axes.plot(xs, ys, color=color, lw=width, alpha=strength, zorder=order, label=f"{word} ({count:,})")
        axes.plot(across[rows, 0], up[rows, 0], "o", mfc="white", mec=color, ms=3, mew=0.7, zorder=5)
        axes.plot(across[rows, -1], up[rows, -1], "o", color=color, ms=2, zorder=5)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, handlelength=1.4, borderpad=0)


def _joined(
    across: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Concatenate the rows of two coordinates with NaN between them, thinned.

    They can then be drawn as one line with gaps, which is faster.
    """
    kept = [extremes(x, y) for x, y in zip(across, up, strict=True)]
    xs, ys = (
        np.concatenate([np.append(row[one], np.nan) for row, one in zip(rows, kept, strict=True)])
        for rows in (across, up)
    )
    return xs, ys


def _draw_presence(axes: Axes, region_map: RegionMap, region: MapRegion) -> None:
    """Draw the share of traces in a region over time, and shade the times at which the region is active.

    A region is active during the time windows of the requirements that refer to it. If one visit to the
    region is enough, a dashed line shows the share of traces that have visited it while it was active.
    """
    color, times = region_map.color(region), region_map.trace.times
    for low, high in region.windows:
        axes.axvspan(
            region_map.trace.t0 + low, region_map.trace.t0 + high, color=FAINT, alpha=0.8, lw=0, zorder=0
        )
    inside = region_map.inside(region)
    share = inside.mean(0)
    kept = extremes(share)
    axes.fill_between(times[kept], share[kept], 0, color=color, alpha=0.35, lw=0, zorder=1)
    axes.plot(times[kept], share[kept], color=color, lw=1.2, zorder=2)
    if region.visited:
        active = region.active(times - region_map.trace.t0)
        so_far = np.logical_or.accumulate(inside & active, axis=1).mean(0)
        axes.plot(times[kept], so_far[kept], color=color, lw=1, ls=(0, (3, 2)), zorder=2)
    axes.set(ylim=(-0.04, 1.12), xlim=(times[0], times[-1]))
    axes.set_yticks([0, 1], ["0", "all"])
    axes.grid(visible=False)
    ending = " (forbidden)" if region.role == "avoid" else ""
    axes.set_title(f"in {region.title}{ending}", color=INK, pad=3)
    axes.set_title(uses_text(region.uses), loc="right", pad=3, color=MUTED, fontsize=7.5, weight="normal")


class _MovingAgents:
    """The agents in an animation, each drawn as a point with a trail."""

    def __init__(self, axes: Axes, region_map: RegionMap) -> None:
        chosen = region_map.first(MOST_AGENTS)
        across, up = region_map.paths
        self._across, self._up = across[chosen], up[chosen]
        self._tail = max(1, round(TAIL / region_map.trace.dt))
        axes.plot(*_joined(self._across, self._up), color=MUTED, lw=0.5, alpha=0.25, zorder=3)
        (self._recent,) = axes.plot([], [], color=INK, lw=1.1, alpha=0.85, zorder=4)
        colors = [RED if violated else INK for violated in region_map.violated[chosen]]
        self._points = axes.scatter(
            self._across[:, 0], self._up[:, 0], s=16, c=colors, lw=0.5, ec="white", zorder=7
        )

    def turn(self, index: int) -> None:
        """Move the agents to their positions at sample `index`."""
        recent = slice(max(0, index - self._tail), index + 1)
        self._recent.set_data(*_joined(self._across[:, recent], self._up[:, recent]))
        self._points.set_offsets(np.column_stack([self._across[:, index], self._up[:, index]]))


# ---------------------------------------------------------------------- regions


Role = Literal["reach", "avoid", "mixed"]
Window: TypeAlias = tuple[float, float]

GRID = 240
"""Grid points along each axis at which a region is evaluated."""
ROOM = 0.06
"""Margin around the visible area, as a share of its size."""
TITLE = 26
"""Maximum number of characters of a region's name in a picture."""


@dataclass(frozen=True, slots=True)
class Use:
    """An occurrence of a region in a requirement.

    Attributes:
        requirement: name of the requirement.
        negative: whether the region is to be avoided: it occurs under an odd number of negations.
        visit: whether one visit is enough: the region occurs under an `eventually`, `once` or `until`.
        window: (first, last) time at which the requirement refers to the region, in seconds since the start
            of the trace; None: at all times.
    """

    requirement: str
    negative: bool
    visit: bool = False
    window: Window | None = None


@dataclass(frozen=True, slots=True)
class MapRegion:
    """A region of the plane.

    Attributes:
        name: name as declared, or the expression of the region.
        uses: occurrences of the region in the specification.
        monitor: computes the distance of points to the border of the region, and thus whether they are
            inside.
    """

    name: str
    uses: tuple[Use, ...]
    monitor: Monitor

    @property
    def title(self) -> str:
        """Name of the region for labels; a long expression is truncated."""
        return self.name if len(self.name) <= TITLE else self.name[: TITLE - 1] + "…"

    @property
    def role(self) -> Role:
        """Role of the region in the specification: reach, avoid, or mixed."""
        kinds = {use.negative for use in self.uses}
        return "mixed" if len(kinds) != 1 else "avoid" if kinds.pop() else "reach"

    @property
    def visited(self) -> bool:
        """True if a single visit to the region is enough."""
        return self.role == "reach" and all(use.visit for use in self.uses)

    @property
    def windows(self) -> tuple[Window, ...]:
        """Time intervals (first, last) in which the region is active.

        A region is active while a requirement refers to it. Times are in seconds since the start of the
        trace. If the region is active all the time, the tuple is empty.
        """
        found = [use.window for use in self.uses]
        return tuple(dict.fromkeys(window for window in found if window)) if all(found) else ()

    def active(self, seconds: Any) -> Mask:
        """Return for each time in `seconds`, since the start of the trace, whether the region is active."""
        windows = self.windows or ((-np.inf, np.inf),)
        return np.asarray(np.any([(low <= seconds) & (seconds <= high) for low, high in windows], axis=0))

    def depth(self, points: Trace) -> NDArray[np.float64]:
        """Signed distance of `points` to the region's border, positive inside: (traces, samples)."""
        (margin,) = self.monitor.requirement_robustness(points).values()
        return np.atleast_2d(margin)


@dataclass(frozen=True, slots=True)
class Plane:
    """Two signals, as the axes of a plane, and the regions in it.

    Attributes:
        axes: names of the two signals.
        regions: regions in the order of the specification.
    """

    axes: tuple[str, str]
    regions: tuple[MapRegion, ...]

    def window(self, trace: Trace) -> tuple[Window, Window]:
        """Limits of the map along both axes, (low, high) each.

        The map shows nearly all of the paths, and the regions near them.
        """
        ends = []
        for name in self.axes:
            values = trace.data[name][np.isfinite(trace.data[name])]
            ends.append(tuple(np.quantile(values, [0.01, 0.99])) if len(values) else (0.0, 1.0))
        lows, highs = np.array(ends).T
        size = max(float((highs - lows).max()), 1e-6 * float(np.abs(ends).max())) or 1.0
        search = ((lows[0] - size, highs[0] + size), (lows[1] - size, highs[1] + size))
        for region in self.regions:
            xs, ys, depth = self.sampled(region, trace, search, count=GRID // 2)
            inside = depth >= 0.0
            if inside.any() and not (inside[0] | inside[-1] | inside[:, 0] | inside[:, -1]).any():
                here = np.array([xs[inside.any(0)][[0, -1]], ys[inside.any(1)][[0, -1]]])
                lows, highs = np.minimum(lows, here[:, 0]), np.maximum(highs, here[:, 1])
        room = ROOM * max(float((highs - lows).max()), size)
        lows, highs = lows - room, highs + room
        return (float(lows[0]), float(highs[0])), (float(lows[1]), float(highs[1]))

    def sampled(
        self,
        region: MapRegion,
        like: Trace,
        window: tuple[Window, Window],
        *,
        count: int = GRID,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Evaluate the signed distance to a region's border, positive inside, at the points of a grid.

        Args:
            region: the region.
            like: trace that declares the signals on the axes.
            window: limits of the grid along both axes.
            count: number of grid points along each axis.

        Returns:
            Ascending horizontal coordinates (count,), ascending vertical coordinates (count,), and distances
            (count, count). Entry [i, k] of the distances is at vertical coordinate i and horizontal
            coordinate k.
        """
        (left, right), (low, high) = window
        xs, ys = np.linspace(left, right, count), np.linspace(low, high, count)
        across, up = np.meshgrid(xs, ys)
        data = dict(zip(self.axes, (across, up), strict=True))
        columns = Signature(tuple(like.signature[name] for name in self.axes))
        grid = replace(like, signature=columns, data=data, extras={})
        return xs, ys, region.depth(grid)


def plane_of(spec: Spec, rules: Iterable[CompiledRequirement], trace: Trace) -> Plane | None:
    """The plane (pair of signals) in which most regions lie; None if the requirements name no region.

    Regions that depend on other signals and regions of more than two dimensions are left out.

    Args:
        spec: syntax tree of the specification.
        rules: its requirements, compiled for recorded traces.
        trace: the trace to evaluate.
    """
    members = {_key(node.span): node for node in spec.walk() if isinstance(node, ast.Member)}
    uses: dict[tuple[str, str], list[Use]] = {}
    for rule in rules:
        for span, use in _uses(rule, trace):
            node = members.get(_key(span))
            if node is not None:
                if node.negated and _point(node) is not node.item:  # a complement, not a `not` around it
                    use = _turned(use)
                uses.setdefault(_texts(node), []).append(use)
    shown = {_texts(node): node for node in members.values()}
    planes: dict[tuple[str, ...], list[MapRegion]] = {}
    for key, its in uses.items():
        monitor = _membership(spec, shown[key], trace)
        if monitor is not None:
            region = MapRegion(key[1], tuple(its), monitor)
            planes.setdefault(monitor.compiled.signature.names, []).append(region)
    flat = [axes for axes in planes if len(axes) == 2 and all(name in trace.data for name in axes)]
    if not flat:
        return None
    axes = max(flat, key=lambda axes: len(planes[axes]))
    return Plane((axes[0], axes[1]), tuple(planes[axes]))


def _membership(spec: Spec, node: ast.Member, trace: Trace) -> Monitor | None:
    """Return a monitor of the single predicate `point in region`; None if it cannot be compiled by itself.

    For example, the predicate may use an argument of a definition.
    """
    declared = spec.vocabulary
    formula = replace(node, item=_point(node), negated=False)
    alone = ast.Require(name="inside", name_span=node.span, tags=(), doc="", span=node.span, formula=formula)
    try:
        monitor = Monitor(replace(spec, items=(*declared, alone)), dt=trace.dt, overrides=trace.meta.spec_set)
        return monitor if monitor.compiled.requirements else None
    except StlcError:
        return None


# ------------------------------------------------------------------ in requirements


def _uses(rule: CompiledRequirement, trace: Trace) -> Iterator[tuple[Span, Use]]:
    """Yield the text of each predicate of a requirement, and a `Use` for its place in the requirement.

    The `Use` tells whether the predicate is under a negation, and to which times it applies.
    """
    stack: list[tuple[typed.Formula, Use]] = [(rule.typed.formula, Use(rule.name, negative=False))]
    while stack:
        node, use = stack.pop()
        operator, parts, places = node.temporal, node.operands, [use] * len(node.operands)
        if not parts and node.children:
            yield node.span, use
        elif node.word in ("not", "->"):
            places[0] = _turned(use)
        elif operator is not None:
            visit = len(parts) > 1 or operator.op in ("eventually", "once")
            places[-1] = replace(_within(operator.interval, use, rule, trace), visit=visit)
        stack += reversed([*zip(parts, places, strict=True)])


def _turned(use: Use) -> Use:
    return replace(use, negative=not use.negative)


def _within(interval: typed.Interval, use: Use, rule: CompiledRequirement, trace: Trace) -> Use:
    """Return a copy of `use` for the part inside a temporal operator with the interval `interval`.

    The time window of the copy is that of the operator, relative to the window of `use`. If the operator is
    evaluated at many instants, its window has no fixed place in time. Then `use` is returned unchanged.
    """
    slides = rule.windowed or (rule.absolute and use.window is None)
    low, high = _seconds(interval.lo, trace), _seconds(interval.hi, trace)
    if low is None or high is None or (interval.clock == "now" and slides):
        return use
    if interval.clock == "now" and use.window is not None:
        low, high = use.window[0] + low, use.window[1] + high
    return replace(use, window=(low, high))


def _seconds(time: typed.Time | None, trace: Trace) -> float | None:
    if time is None or time.horizons:
        return None
    return float(time.seconds) + float(time.steps) * trace.dt


def _key(span: Span) -> tuple[str, int, int]:
    return span.source.name, span.start, span.end


def _point(node: ast.Member) -> ast.Expr:
    """Return the point of the predicate `point in region`.

    If the point is `sweep(p)` (the motion between samples), `p` is returned.
    """
    match node.item:
        case ast.Call(func=ast.Name(name="sweep"), args=(arg,)):
            return arg.value
        case _:
            return node.item


def _texts(node: ast.Member) -> tuple[str, str]:
    """Return (text of the point, text of the region) of the predicate `point in region`.

    The two texts together identify a region of the map.
    """
    point, region = (" ".join(part.span.text.split()) for part in (_point(node), node.region))
    return point, region


def uses_text(uses: Sequence[Use]) -> str:
    """The requirements that name a region, with their times, such as `pass_gate 1 to 3 s`."""
    times = [f" {use.window[0]:g} to {use.window[1]:g} s" if use.window else "" for use in uses]
    return ", ".join(dict.fromkeys(use.requirement + time for use, time in zip(uses, times, strict=True)))
