"""Films: something drawn frame by frame, and how it becomes a GIF or a still."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stlc.files import write_atomic
from stlc.trace import Trace
from stlc.view.style import FAINT, INK, ORANGE, PAPER, look, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

MAX_FRAMES = 150
MAX_BYTES = 4_000_000
COLOURS = 64
MOST_PANELS, MOST_AGENTS = 6, 40
_LONGER_SIDE = 760  # pixels

Scene = Mapping[str, NDArray[Any]]
DrawScene = Callable[[Any, Scene, int], None]


@dataclass(frozen=True, slots=True)
class Film:
    """Something that can be drawn frame by frame.

    Attributes:
        frames: how many instants there are.
        dt: seconds between them.
        size: of the picture in inches.
        begin: prepares an empty figure and returns what turns it to an instant.
        alt: what is seen, in words.
    """

    frames: int
    dt: float
    size: tuple[float, float]
    begin: Callable[[Figure], Callable[[int], None]]
    alt: str


def scene_film(scene: Scene, draw: DrawScene, dt: float, *, title: str = "") -> Film:
    """The film of a recorded scene (arrays (instants, …)), drawn by its world."""

    def begin(figure: Figure) -> Callable[[int], None]:
        figure.set_layout_engine("none")
        axes = figure.add_axes((0.0, 0.0, 1.0, 0.955))
        figure.text(0.02, 0.972, title, color=INK, va="center", weight="bold")
        clock = figure.text(0.98, 0.972, "", color=INK, va="center", ha="right")

        def turn(index: int) -> None:
            axes.clear()
            draw(axes, scene, index)
            clock.set_text(f"{index * dt:.1f} s")

        return turn

    frames = min(len(values) for values in scene.values())
    return Film(frames, dt, _fitting_size(draw, scene), begin, f"{title}: {frames * dt:.0f} s of deployment.")


def signal_film(trace: Trace, *, title: str = "") -> Film:
    """The film of a trace without a world: every agent's signals, drawn up to now."""
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
    return Film(trace.samples, trace.dt, (6.4, height), begin, f"{title}: signals of {trace.traces} agents.")


def _panel(axes: Axes, trace: Trace, name: str) -> Callable[[int], None]:
    """One signal of at most `MOST_AGENTS` agents; all curves are one line with gaps, which draws fast."""
    values = trace.data[name][:MOST_AGENTS]
    gap = np.full((len(values), 1), np.nan)
    unit = trace.signature[name].unit.text
    axes.set_ylabel(f"{name} [{unit}]" if unit not in ("", "1") else name)
    times = np.broadcast_to(trace.times, values.shape)
    axes.plot(np.hstack([times, gap]).ravel(), np.hstack([values, gap]).ravel(), color=FAINT, lw=0.8)
    (past,) = axes.plot([], [], color=INK, lw=0.8, alpha=0.7)
    (present,) = axes.plot([], [], "o", color=ORANGE, ms=3)

    def turn(index: int) -> None:
        until = slice(0, index + 1)
        past.set_data(np.hstack([times[:, until], gap]).ravel(), np.hstack([values[:, until], gap]).ravel())
        present.set_data(times[:, index], values[:, index])

    return turn


def save_gif(film: Film, path: Path, *, max_frames: int = MAX_FRAMES, max_bytes: int = MAX_BYTES) -> Path:
    """Write `film` to `path`, in real time, smaller in width where it would exceed `max_bytes`."""
    stride = max(1, -(-film.frames // max_frames))
    indices = range(0, film.frames, stride)
    pictures = list(_frames(film, indices))
    milliseconds = max(20, round(1000 * stride * film.dt))
    data = _encoded(pictures, milliseconds)
    while len(data) > max_bytes and pictures[0].width > 160:
        factor = max(0.6, 0.95 * (max_bytes / len(data)) ** 0.5)
        size = (round(pictures[0].width * factor), round(pictures[0].height * factor))
        pictures = [picture.resize(size) for picture in pictures]
        data = _encoded(pictures, milliseconds)
    write_atomic(path, data)
    return path


def save_still(film: Film, path: Path, *, at: float = 0.5, dpi: int = 160) -> Path:
    """Write the instant at the share `at` of `film` as PNG."""
    index = min(film.frames - 1, int(at * film.frames))
    with look():
        figure = new_figure(*film.size)
        film.begin(figure)(index)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=dpi, facecolor=PAPER)
    write_atomic(path, buffer.getvalue())
    return path


def _fitting_size(draw: DrawScene, scene: Scene) -> tuple[float, float]:
    """A size of 6.4 inches at the longer side with the proportions of what the world draws."""
    with look():
        axes = new_figure(4, 4).add_subplot()
        draw(axes, scene, 0)
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        fixed = axes.get_aspect() != "auto"
    ratio = float(abs((high - low) / (right - left))) if fixed and right != left else 0.6
    ratio = min(max(ratio, 0.25), 1.6)
    width, height = (6.4, 6.4 * ratio) if ratio <= 1 else (6.4 / ratio, 6.4)
    return width, height / 0.955


def _frames(film: Film, indices: range) -> Iterator[Image]:
    """The instants as RGB images of `_LONGER_SIDE` along the longer side."""
    from PIL import Image

    with look():
        figure = new_figure(*film.size)
        figure.set_dpi(_LONGER_SIDE / max(film.size))
        figure.set_facecolor(PAPER)
        turn = film.begin(figure)
        canvas: Any = figure.canvas
        for index in indices:
            turn(index)
            canvas.draw()
            yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _encoded(pictures: list[Image], milliseconds: int) -> bytes:
    """`pictures` as a GIF with one palette for all, taken from a few of them."""
    from PIL import Image

    sample = pictures[:: max(1, len(pictures) // 6)][:6]
    sheet = Image.new("RGB", (sample[0].width, sample[0].height * len(sample)))
    for row, picture in enumerate(sample):
        sheet.paste(picture, (0, row * picture.height))
    palette = _palette(sheet)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    buffer = io.BytesIO()
    frames[0].save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=milliseconds,
        loop=0,
        optimize=True,
    )
    return buffer.getvalue()


def _palette(sheet: Image) -> Image:
    """The colours that cover most, exactly (white paper stays white), and a choice of the others."""
    from PIL import Image

    counts: Any = sheet.getcolors(sheet.width * sheet.height)
    frequent = [color for _, color in sorted(counts, reverse=True)[: COLOURS // 2]]
    mixed = np.array(sheet.quantize(COLOURS // 2, dither=Image.Dither.NONE).getpalette()).reshape(-1, 3)
    near = np.abs(mixed[:, None] - np.array(frequent)[None]).max(axis=2).min(axis=1) <= 8
    colours = np.concatenate([np.array(frequent), mixed[~near]])
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours.ravel().tolist())
    return palette
