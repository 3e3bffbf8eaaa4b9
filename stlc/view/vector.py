"""Animations as drawing commands instead of pixels: paths, texts and images.

A web page replays the commands. `CommandRenderer` is a matplotlib renderer that records them. A command that
several frames use is stored once. Coordinates are integers in quarters of a pixel, from the upper left.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.colors import to_hex
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D

from stlc.view.animation import Animation, Command, VectorAnimation, clear_artists
from stlc.view.style import new_figure, picture_style

FINE = 4
"""Steps of the integer coordinates per dot."""
DPI = 100
PICTURE = 720
"""Maximum width of an embedded image in dots."""
QUALITY = 60
_LETTERS = {Outline.MOVETO: "m", Outline.LINETO: "l", Outline.CURVE3: "q", Outline.CURVE4: "c"}


def vector_frames(
    draw: Callable[[Any, int], None], frames: Sequence[int], size: tuple[float, float]
) -> VectorAnimation:
    """Record the drawing commands of the given frames.

    The function `draw(axes, index)` draws frame `index` on axes that fill a figure of `size` inches.
    """
    with picture_style():
        figure = new_figure(*size)
        figure.set_dpi(DPI)
        figure.set_layout_engine("none")
        axes = figure.add_axes((0, 0, 1, 1))
        renderer = CommandRenderer(round(size[0] * DPI), round(size[1] * DPI))
        for index in frames:
            clear_artists(axes)
            draw(axes, index)
            renderer.begin()
            axes.draw(renderer)
    return renderer.recorded()


def vector_animation(animation: Animation, frames: Sequence[int]) -> VectorAnimation:
    """Return the frames of an animation whose indices are in `frames`, as drawing commands."""
    with picture_style():
        figure = new_figure(*animation.size)
        figure.set_dpi(DPI)
        turn = animation.begin(figure)
        renderer = CommandRenderer(round(animation.size[0] * DPI), round(animation.size[1] * DPI))
        for index in frames:
            turn(index)
            renderer.begin()
            figure.draw(renderer)
    return renderer.recorded()


class CommandRenderer(RendererBase):
    """Matplotlib renderer that records drawing commands frame by frame."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__()
        self.width, self.height = width, height
        self._known: dict[Command, int] = {}
        self._frames: list[list[int]] = []
        self._letters: Any = RendererAgg(width, height, DPI)  # type: ignore[no-untyped-call]

    def begin(self) -> None:
        """Begin the next frame."""
        self._frames.append([])

    def recorded(self) -> VectorAnimation:
        """Return all drawing commands that the renderer has recorded, by frame."""
        frames = tuple(tuple(frame) for frame in self._frames)
        return VectorAnimation(self.width, self.height, tuple(self._known), frames)

    def _enter(self, command: Command) -> None:
        self._frames[-1].append(self._known.setdefault(command, len(self._known)))

    # ------------------------------------------------------------- matplotlib's renderer interface

    def draw_path(self, gc: Any, path: Any, transform: Any, rgbFace: Any = None) -> None:  # noqa: N803
        """Record a path, filled if it has a face colour."""
        line = None if gc.get_linewidth() == 0 else _color(gc.get_rgb(), gc)
        face = None if rgbFace is None else _color(rgbFace, gc)
        text = self._path(path, transform)
        if text and (line or face):
            width = round(self.points_to_pixels(gc.get_linewidth()), 2)
            _, pattern = gc.get_dashes()
            dash = (
                None
                if pattern is None
                else " ".join(f"{self.points_to_pixels(length):.3g}" for length in pattern)
            )
            area, moved = gc.get_clip_path()
            clip = None if area is None else self._path(area, moved)
            self._enter(("p", text, face, line, width if line else 0, dash, clip))

    def draw_image(self, gc: Any, x: float, y: float, im: Any, transform: Any = None) -> None:  # noqa: ARG002
        """Record an image, scaled down if it is large."""
        from PIL import Image

        height, width = im.shape[:2]
        picture = Image.fromarray(np.ascontiguousarray(im[::-1]))
        paper = Image.new("RGB", picture.size, "white")
        paper.paste(picture, mask=picture.getchannel("A"))
        if paper.width > PICTURE:
            paper = paper.resize((PICTURE, round(PICTURE * height / width)))
        buffer = io.BytesIO()
        paper.save(buffer, format="webp", quality=QUALITY)
        address = "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
        self._enter(("i", round(x), round(self.height - y - height), width, height, address))

    def draw_text(
        self,
        gc: Any,
        x: float,
        y: float,
        s: str,
        prop: Any,
        angle: float,
        ismath: Any = False,
        mtext: Any = None,
    ) -> None:
        """Record a line of text.

        The recorded position is on the baseline, at the left end, the centre or the right end of the text,
        depending on its alignment.
        """
        wide, _, _ = self.get_text_width_height_descent(s, prop, ismath)
        align = "left" if mtext is None else mtext.get_horizontalalignment()
        along = {"left": 0.0, "center": 0.5, "right": 1.0}[align] * wide
        turn = np.radians(angle)
        at = (round(FINE * (x + along * np.cos(turn))), round(FINE * (y - along * np.sin(turn))))
        size = round(self.points_to_pixels(prop.get_size_in_points()), 1)
        bold = prop.get_weight() in ("bold", 700)
        self._enter(("t", *at, s, size, _color(gc.get_rgb(), gc), align, round(-angle), int(bold)))

    def get_text_width_height_descent(self, s: str, prop: Any, ismath: Any) -> tuple[float, float, float]:
        """Width, height and descent of a text in dots, as measured by matplotlib's Agg renderer."""
        wide, high, deep = self._letters.get_text_width_height_descent(s, prop, ismath)
        return float(wide), float(high), float(deep)

    def get_canvas_width_height(self) -> tuple[float, float]:
        """Size of the canvas in dots."""
        return self.width, self.height

    def points_to_pixels(self, points: Any) -> Any:
        """Convert lengths in points to dots."""
        return points * DPI / 72

    def flipy(self) -> bool:
        """Return True: the origin is the upper left."""
        return True

    def option_image_nocomposite(self) -> bool:
        """Return True: images are not merged."""
        return True

    # ------------------------------------------------------------------------------------- pieces

    def _path(self, path: Any, transform: Any) -> str:
        """Convert a path to SVG notation with relative coordinates."""
        flip = transform + Affine2D().scale(FINE, -FINE).translate(0, FINE * self.height)
        words: list[str] = []
        x = y = 0
        begun = (0, 0)
        outline = path.cleaned(flip, simplify=False, curves=True, remove_nans=True)
        corners = np.rint(np.clip(np.nan_to_num(outline.vertices), -99_999, 99_999)).astype(int).tolist()
        codes, first = outline.codes.tolist(), 0
        while codes[first] != Outline.STOP:
            code, ends = codes[first], corners[first : first + Outline.NUM_VERTICES_FOR_CODE[codes[first]]]
            first += len(ends)
            if code == Outline.CLOSEPOLY:
                words.append("z")
                x, y = begun
                continue
            if code == Outline.MOVETO:
                begun = (ends[0][0], ends[0][1])
                if words and (x, y) == begun and words[-1] != "z":
                    continue  # the line continues
                words.append(f"M{begun[0]} {begun[1]}")
            else:
                words.append(_LETTERS[code] + " ".join(f"{a - x} {b - y}" for a, b in ends))
            x, y = ends[-1]
        return "".join(words)


def _color(color: Any, gc: Any) -> str | None:
    """Colour as `#rrggbb`, with two more digits if opacity is below 1; None if fully transparent."""
    alpha = gc.get_alpha() if gc.get_forced_alpha() else color[3] if len(color) > 3 else 1.0
    if not alpha:
        return None
    return to_hex((*color[:3], alpha), keep_alpha=alpha < 1)
