"""Animation of a recorded scene, with a legend above it and strip charts below it.

A scene is a mapping from names to arrays that a closed-loop run recorded for its animation. The world, which
is the simulated environment of the run, draws the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from stlc.controller.sketch import DECIDED, DECIDERS, VIOLATED
from stlc.view.animation import Animation, clear_artists, speed_up
from stlc.view.signals import MARGINS, FrameUpdate, Strip, draw_strip
from stlc.view.style import INK, MUTED, new_figure, picture_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

Scene = Mapping[str, NDArray[Any]]
DrawScene = Callable[[Any, Scene, int], None]

WIDTH, TALLEST = 7.6, 4.4
"""Width of a picture in inches; greatest height of a scene whose charts are below it instead of beside it."""
_HEAD, _KEYS, _EDGE = 0.36, 0.24, 0.12
_ROW, _GAP, _FOOT = 0.27, 0.07, 0.42
_NAMES, _VALUES = 1.15, 0.62
_BESIDE = 3.8


@dataclass(frozen=True, slots=True)
class LegendKey:
    """An entry of a legend.

    Attributes:
        word: label.
        color: colour of the symbol.
        kind: kind of symbol: `dot`, `ring`, or a line, `dash` or `solid`.
    """

    word: str
    color: str
    kind: Literal["dot", "ring", "dash", "solid"] = "dot"


@dataclass(frozen=True, slots=True)
class SceneOptions:
    """Parameters of a scene's animation.

    Attributes:
        draw: function that draws a frame of a scene on axes: `draw(axes, scene, index)`.
        dt: seconds between frames.
        title: title of the picture.
        keys: additional legend entries, label -> colour.
        strip: strip charts; None: no charts.
    """

    draw: DrawScene
    dt: float
    title: str = ""
    keys: Mapping[str, str] = field(default_factory=dict)
    strip: Strip | None = None


@dataclass(frozen=True, slots=True)
class _Plan:
    """Layout of a scene's animation, in inches; a rectangle is (left, bottom, width, height).

    Attributes:
        size: width and height of the picture.
        scene: rectangle of the scene.
        rows: rectangles of the strip charts.
    """

    size: tuple[float, float]
    scene: tuple[float, float, float, float]
    rows: tuple[tuple[float, float, float, float], ...]


def frames_of(scene: Scene) -> int:
    """Number of frames of a scene, a mapping from names to recorded arrays (frames, …)."""
    return min(len(values) for values in scene.values())


def scene_animation(scene: Scene, options: SceneOptions) -> Animation:
    """Animation of a scene, which is a mapping from names to recorded arrays (frames, …)."""
    frames = frames_of(scene)
    keys = keys_of(scene, options.keys)
    plan = _planned(ratio_of(options.draw, scene), 0 if options.strip is None else options.strip.height, keys)
    seconds, speed = (frames - 1) * options.dt, speed_up(frames, options.dt)

    def begin(figure: Figure) -> Callable[[int], None]:
        figure.set_layout_engine("none")
        clock = _head(figure, plan, options.title, keys)
        updates = _draw_over_time(figure, plan, options.strip)
        axes = _panel(figure, plan, plan.scene)
        moving = [axes, clock, *(artist for update in updates for artist in update.artists)]
        for artist in moving:
            artist.set_animated(True)  # not part of the background, which is drawn once
        canvas: Any = figure.canvas
        canvas.draw()
        ground = canvas.copy_from_bbox(figure.bbox)

        def turn(index: int) -> None:
            clear_artists(axes)
            options.draw(axes, scene, index)
            pace = f"   {speed}x" if speed > 1 else ""
            clock.set_text(f"{index * options.dt:.1f} s{pace}")
            for update in updates:
                update.turn(index)
            canvas.restore_region(ground)
            for artist in moving:
                figure.draw_artist(artist)

        return turn

    alt = f"{options.title}: {seconds:.0f} s of deployment."
    return Animation(frames, options.dt, plan.size, begin, alt, _moment(scene, frames), draws=True)


def _moment(scene: Scene, frames: int) -> int:
    """Index of the frame with the most interventions of the guard.

    The first sixth and the last sixth of the frames are not considered. Without interventions, the index of
    the middle frame is returned.
    """
    middle = frames // 2
    low, high = frames // 6, max(frames - frames // 6, frames // 6 + 1)
    acted = (scene["decision"][low:high] > 0).sum(1) if "decision" in scene else np.zeros(0)
    if not acted.any():
        return middle
    best = np.flatnonzero(acted == acted.max()) + low
    return int(best[np.abs(best - middle).argmin()])


def ratio_of(draw: DrawScene, scene: Scene) -> float:
    """Return the aspect ratio (height / width) of the picture that `draw` makes of a scene.

    It is limited to the range 0.15 to 1.6.
    """
    with picture_style():
        axes = new_figure(4, 4).add_subplot()
        draw(axes, scene, 0)
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        fixed = axes.get_aspect() != "auto"
    ratio = float(abs((high - low) / (right - left))) if fixed and right != left else 0.6
    return min(max(ratio, 0.15), 1.6)


def _planned(ratio: float, rows: int, keys: list[LegendKey]) -> _Plan:
    head = _HEAD + (_KEYS if keys else 0.0)
    width = WIDTH - 2 * _EDGE
    high = rows * (_ROW + _GAP) + _FOOT + 0.2 if rows else 0.0
    if width * ratio <= TALLEST:
        scene = (_EDGE, high + _EDGE, width, width * ratio)
        bottom = high - 0.2 - _ROW
        boxes = [
            (_EDGE + _NAMES, bottom - row * (_ROW + _GAP), width - _NAMES - _VALUES, _ROW)
            for row in range(rows)
        ]
        return _Plan((WIDTH, head + scene[3] + scene[1]), scene, tuple(boxes))
    tall = TALLEST + 0.4
    wide = tall / ratio
    scene = (_EDGE, _EDGE, wide, tall)
    total = wide + 2 * _EDGE + (_BESIDE if rows else 0.0)
    room = (tall - _FOOT - 0.2) / max(rows, 1)
    left = wide + 2 * _EDGE + _NAMES
    boxes = [
        (left, _EDGE + _FOOT + (rows - 1 - row) * room, _BESIDE - _NAMES - _VALUES, min(room - 0.1, 0.8))
        for row in range(rows)
    ]
    return _Plan((total, head + tall + _EDGE), scene, tuple(boxes))


def _panel(figure: Figure, plan: _Plan, box: tuple[float, float, float, float]) -> Axes:
    (width, height), (left, bottom, wide, high) = plan.size, box
    return figure.add_axes((left / width, bottom / height, wide / width, high / height))


def keys_of(scene: Scene, own: Mapping[str, str]) -> list[LegendKey]:
    """Return the legend entries of a scene, and those in `own` (label -> colour).

    The entries of the scene are the recorded sources of decisions, rejected plans, and violations.
    """
    sources = {0, *np.unique(scene["decision"]).tolist()} if "decision" in scene else set()
    keys = [LegendKey(DECIDERS[source], DECIDED[source]) for source in sorted(sources)]
    if "rejected" in scene and np.isfinite(scene["rejected"]).any():
        keys.append(LegendKey("rejected plan", VIOLATED, "dash"))
    if "violated" in scene and scene["violated"].any():
        keys.append(LegendKey("violated", VIOLATED, "ring"))
    return keys + [LegendKey(word, color) for word, color in own.items()]


def _handle(key: LegendKey) -> Line2D:
    from matplotlib.lines import Line2D

    if key.kind in ("dash", "solid"):
        style: Any = (0, (2.5, 1.5)) if key.kind == "dash" else "-"
        return Line2D([], [], color=key.color, lw=1.6, ls=style)
    face = "none" if key.kind == "ring" else key.color
    return Line2D([], [], marker="o", ls="", ms=7, mew=1.8 if face == "none" else 0, mfc=face, mec=key.color)


def _head(figure: Figure, plan: _Plan, title: str, keys: list[LegendKey]) -> Text:
    """Draw title, time and legend; return the text that shows the time."""
    width, height = plan.size
    top = 1 - 0.5 * _HEAD / height
    figure.text(_EDGE / width, top, title, color=INK, va="center", weight="bold", fontsize=10)
    clock = figure.text(1 - _EDGE / width, top, "", color=INK, va="center", ha="right", fontsize=10)
    if keys:
        figure.legend(
            [_handle(key) for key in keys],
            [key.word for key in keys],
            loc="center left",
            bbox_to_anchor=(0.0, 1 - (_HEAD + 0.4 * _KEYS) / height),
            ncols=len(keys),
            handlelength=1.5,
            handletextpad=0.3,
            columnspacing=1.0,
            borderpad=0.2,
            fontsize=8,
            labelcolor=INK,
        )
    return clock


def _draw_over_time(figure: Figure, plan: _Plan, strip: Strip | None) -> list[FrameUpdate]:
    """Draw the strip charts, with a heading above the first one.

    Returns the functions that update the charts to a given frame.
    """
    if strip is None or not plan.rows:
        return []
    updates = draw_strip(strip, [_panel(figure, plan, box) for box in plan.rows])
    (width, height), (left, bottom, wide, high) = plan.size, plan.rows[0]
    narrow = wide < WIDTH / 2
    words = f"{MARGINS}, red where violated"
    words = words.replace(", ", ",\n") if narrow else words
    at = ((left - (_NAMES - 0.2 if narrow else 0.0)) / width, (bottom + high + 0.05) / height)
    figure.text(*at, words, color=MUTED, fontsize=7.5, va="bottom")
    return updates
