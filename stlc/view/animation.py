"""Animations drawn frame by frame, and their encoding as GIF or still picture."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.files import File
from stlc.view.style import PAPER, new_figure, picture_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image


MAX_FRAMES = 240
MAX_BYTES = 4_000_000
LONGEST = 16.0
"""Maximum duration of an animation in seconds; longer recordings are sped up."""
DPI, FINE = 100, 2
"""Dots per inch of a GIF; factor by which still pictures have more."""
QUALITY = 86
"""WebP quality of a still."""


@dataclass(frozen=True, slots=True)
class Animation:
    """Animation: a function that draws the picture of each instant.

    Attributes:
        frames: number of instants.
        dt: seconds between instants.
        size: width and height of the picture in inches.
        begin: function that prepares an empty figure. It returns another function, which draws the instant of
            a given index on the figure's canvas.
        alt: description in words.
        moment: index of the instant shown in a still picture.
        draws: True if the function that `begin` returns also renders the canvas. False if it only updates the
            drawn objects (artists), so that the caller must render.
    """

    frames: int
    dt: float
    size: tuple[float, float]
    begin: Callable[[Figure], Callable[[int], None]]
    alt: str
    moment: int = 0
    draws: bool = False

    @property
    def speed(self) -> int:
        """Speed of the animation as a multiple of real time."""
        return speed_up(self.frames, self.dt)

    def images(self, indices: range, dpi: int) -> Iterator[Image]:
        """Yield the instants `indices` as RGB images."""
        from PIL import Image

        with picture_style():
            figure = new_figure(*self.size)
            figure.set_dpi(dpi)
            figure.set_facecolor(PAPER)
            turn = self.begin(figure)
            canvas: Any = figure.canvas
            for index in indices:
                turn(index)
                if not self.draws:
                    canvas.draw()
                yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


Command: TypeAlias = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class VectorAnimation:
    """An animation as a list of drawing commands, which a web page replays.

    Attributes:
        width: width of the picture in pixels.
        height: height of the picture in pixels.
        commands: the distinct drawing commands. A path is `["p", path, fill, stroke, width, dash, clip]`. A
            text is `["t", x, y, text, size, color, align, angle, bold]`. An image is `["i", x, y, width,
            height, address]`, in which `address` is a `data:` URI that contains the image.
        frames: for every frame, indices into `commands` in the order of drawing.
    """

    width: int
    height: int
    commands: tuple[Command, ...]
    frames: tuple[tuple[int, ...], ...]

    @property
    def colors(self) -> set[str]:
        """All colours that the commands use, as `#rrggbb`."""
        found = {str(color)[:7] for c in self.commands if c[0] == "p" for color in c[2:4] if color}
        return found | {str(c[5])[:7] for c in self.commands if c[0] == "t"}

    @property
    def pictured(self) -> bool:
        """True if the commands contain images."""
        return any(command[0] == "i" for command in self.commands)

    def as_json(self) -> dict[str, Any]:
        """The animation as dictionaries and lists for JSON."""
        return {
            "width": self.width,
            "height": self.height,
            "commands": [list(command) for command in self.commands],
            "frames": [list(frame) for frame in self.frames],
        }


def dark_colors(all_: Sequence[VectorAnimation], dark: Mapping[str, str]) -> Mapping[str, str]:
    """Return `dark` if all animations can be shown in these colours, else an empty mapping.

    `dark` maps each colour to the colour that replaces it in the dark scheme. An animation cannot be shown if
    it contains images, or colours that `dark` does not list.
    """
    known = all(each.colors <= dark.keys() and not each.pictured for each in all_)
    return dark if known else {}


def clear_artists(axes: Axes) -> None:
    """Remove all artists (drawn objects) from `axes`; this is much faster than clearing the axes."""
    for artist in (*axes.lines, *axes.patches, *axes.collections, *axes.texts, *axes.images):
        artist.remove()
    axes.dataLim.set_points(np.array([[np.inf, np.inf], [-np.inf, -np.inf]]))
    axes.ignore_existing_data_limits = True


def speed_up(frames: int, dt: float) -> int:
    """Smallest integer factor of real time at which the animation lasts at most `LONGEST` seconds."""
    return max(1, int(np.ceil(frames * dt / LONGEST)))


def save_animation(
    animation: Animation,
    gif: Path,
    *,
    max_frames: int = MAX_FRAMES,
    max_bytes: int = MAX_BYTES,
) -> None:
    """Write an animation as a GIF.

    Args:
        animation: the animation.
        gif: path of the GIF, whose width is reduced if the file would exceed `max_bytes`.
        max_frames: maximum number of frames. If there are more instants, only every second, third, … instant
            is shown.
        max_bytes: maximum size of the GIF.

    Raises:
        MissingError: R201, the file cannot be written.
    """
    stride = max(1, -(-animation.frames // max_frames))
    milliseconds = max(20, round(1000 * stride * animation.dt / animation.speed))
    pictures = list(animation.images(range(0, animation.frames, stride), DPI))
    File(gif).write(fitting(pictures, milliseconds, max_bytes))


def save_still(animation: Animation, path: Path, *, at: int | None = None, dpi: int = FINE * DPI) -> Path:
    """Write instant `at` of `animation` (default: its `moment`) as PNG or WebP to `path`; return `path`."""
    File(path).write(still_bytes(animation, "webp" if path.suffix == ".webp" else "png", at=at, dpi=dpi))
    return path


def still_bytes(
    animation: Animation, kind: Literal["png", "webp"] = "webp", *, at: int | None = None, dpi: int = DPI
) -> bytes:
    """Return a PNG or WebP file of one instant of `animation` (default: its `moment`), as bytes."""
    index = min(animation.frames - 1, animation.moment if at is None else at)
    (picture,) = animation.images(range(index, index + 1), dpi)
    buffer = io.BytesIO()
    if kind == "webp":
        picture.save(buffer, format="webp", quality=QUALITY)
    else:
        picture.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


# ---------------------------------------------------------------------- gif


COLOURS = 96
SAMPLED = 8
"""Number of frames from which the palette is computed, including the first and the last one."""
NARROWEST = 160  # pixels


def fitting(pictures: Sequence[Image], milliseconds: int, max_bytes: int) -> bytes:
    """Encode pictures as a GIF, each shown for `milliseconds`.

    The width is reduced until the file has at most `max_bytes`, but not below `NARROWEST` pixels.
    """
    data = encoded(pictures, milliseconds)
    while len(data) > max_bytes and pictures[0].width > NARROWEST:
        factor = max(0.6, 0.95 * (max_bytes / len(data)) ** 0.5)
        size = (round(pictures[0].width * factor), round(pictures[0].height * factor))
        pictures = [picture.resize(size) for picture in pictures]
        data = encoded(pictures, milliseconds)
    return data


def encoded(pictures: Sequence[Image], milliseconds: int) -> bytes:
    """Encode pictures, each shown for `milliseconds`, as a GIF that repeats forever.

    The palette is computed from a few of the pictures.
    """
    from PIL import Image

    many = min(SAMPLED, len(pictures))
    sample = [pictures[row * (len(pictures) - 1) // max(many - 1, 1)] for row in range(many)]
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
    """Choose the colour palette of a picture.

    Half of the palette consists of the most frequent colours of the picture. The other colours are added one
    by one. Each time, the colour with the greatest distance to the palette, weighted by its frequency, is
    added. Small details, such as a dot in a legend or a red line, thus keep their colour. White stays exactly
    white.
    """
    from PIL import Image

    counts: Any = sheet.getcolors(sheet.width * sheet.height)
    often = np.array([count for count, _ in counts], dtype=float)
    colours = np.array([colour for _, colour in counts], dtype=float)
    chosen = np.argsort(-often, kind="stable")[: COLOURS // 2].tolist()
    far = np.min([_apart(colours, colours[index]) for index in chosen], axis=0)
    while len(chosen) < COLOURS and far.any():
        chosen.append(int(np.argmax(far * np.sqrt(often))))
        far = np.minimum(far, _apart(colours, colours[chosen[-1]]))
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours[chosen].astype(int).ravel().tolist())
    return palette


def _apart(colours: NDArray[np.float64], one: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances of `colours` (colours, 3) from the colour `one` (3,)."""
    return np.asarray(((colours - one) ** 2).sum(1))
