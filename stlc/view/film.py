"""Films: something drawn frame by frame, and how it becomes a GIF, a video or a still."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from stlc.files import write_atomic
from stlc.view.gif import fitting
from stlc.view.style import PAPER, look, new_figure
from stlc.view.video import video

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

MAX_FRAMES = 240
MAX_BYTES = 4_000_000
LONGEST = 16.0
"""Seconds that a film lasts; what took longer is shown faster."""
DPI, FINE = 100, 2
"""Dots per inch of a GIF, and how many times as many a video and a still have."""
QUALITY = 86
"""Of WebP."""


@dataclass(frozen=True, slots=True)
class Film:
    """Something that can be drawn frame by frame.

    Attributes:
        frames: how many instants there are.
        dt: seconds between them.
        size: of the picture in inches.
        begin: prepares an empty figure and returns what draws an instant on its canvas.
        alt: what is seen, in words.
        moment: the instant that tells most, for a still.
        draws: whether what `begin` returns draws by itself; otherwise it only changes what is to be drawn.
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
        """How many times as fast as the truth it is shown."""
        return speed_of(self.frames, self.dt)


Command: TypeAlias = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Taped:
    """A film as commands.

    Attributes:
        width, height: of the picture, in dots.
        commands: what is drawn, each once: `["p", path, fill, stroke, width, dash, clip]`,
            `["t", x, y, text, size, color, align, angle, bold]`, `["i", x, y, width, height, address]`.
        frames: numbers of the commands of every frame, in the order of drawing.
    """

    width: int
    height: int
    commands: tuple[Command, ...]
    frames: tuple[tuple[int, ...], ...]

    @property
    def colors(self) -> set[str]:
        """All that are used, as `#rrggbb`."""
        found = {str(color)[:7] for c in self.commands if c[0] == "p" for color in c[2:4] if color}
        return found | {str(c[5])[:7] for c in self.commands if c[0] == "t"}

    @property
    def pictured(self) -> bool:
        """Whether there are pictures among the commands."""
        return any(command[0] == "i" for command in self.commands)

    def as_json(self) -> dict[str, Any]:
        """The same as plain data."""
        return {
            "width": self.width,
            "height": self.height,
            "commands": [list(command) for command in self.commands],
            "frames": [list(frame) for frame in self.frames],
        }


def in_the_dark(tapes: Sequence[Taped], dark: Mapping[str, str]) -> Mapping[str, str]:
    """The colours on dark paper; none where a tape has pictures, or colours that nobody has chosen."""
    known = all(tape.colors <= dark.keys() and not tape.pictured for tape in tapes)
    return dark if known else {}


def wipe(axes: Axes) -> None:
    """Take everything away that was drawn; far quicker than to begin axes anew."""
    for artist in (*axes.lines, *axes.patches, *axes.collections, *axes.texts, *axes.images):
        artist.remove()
    axes.dataLim.set_points(np.array([[np.inf, np.inf], [-np.inf, -np.inf]]))
    axes.ignore_existing_data_limits = True


def speed_of(frames: int, dt: float) -> int:
    """The whole number of times as fast at which so many frames take `LONGEST` at most."""
    return max(1, int(np.ceil(frames * dt / LONGEST)))


def save_film(
    film: Film,
    gif: Path,
    mp4: Path | None = None,
    *,
    max_frames: int = MAX_FRAMES,
    max_bytes: int = MAX_BYTES,
) -> None:
    """Write `film` as a GIF, and as a video, too, drawing every instant once.

    Args:
        film: what is shown.
        gif: path of the GIF, smaller in width where it would exceed `max_bytes`.
        mp4: path of the video.
        max_frames: instants are left out evenly beyond that.
        max_bytes: of the GIF.

    Raises:
        MissingError: R201, a file cannot be written; R301, there is no ffmpeg for the video.
    """
    stride = max(1, -(-film.frames // max_frames))
    milliseconds = max(20, round(1000 * stride * film.dt / film.speed))
    fine = FINE if mp4 is not None else 1
    small: list[Image] = []
    with ExitStack() as stack:
        write: Callable[[Image], None] | None = None
        for picture in frames_in(film, range(0, film.frames, stride), fine * DPI):
            if mp4 is not None:
                write = write or stack.enter_context(video(mp4, picture.size, milliseconds))
                write(picture)
            small.append(picture.reduce(fine) if fine > 1 else picture)
    write_atomic(gif, fitting(small, milliseconds, max_bytes))


def save_still(film: Film, path: Path, *, at: int | None = None, dpi: int = FINE * DPI) -> Path:
    """Write the instant number `at` of `film`, by default the one that tells most, as PNG or WebP."""
    write_atomic(path, still_bytes(film, "webp" if path.suffix == ".webp" else "png", at=at, dpi=dpi))
    return path


def still_bytes(
    film: Film, kind: Literal["png", "webp"] = "webp", *, at: int | None = None, dpi: int = DPI
) -> bytes:
    """One instant of `film`, by default the one that tells most, as the content of a file."""
    index = min(film.frames - 1, film.moment if at is None else at)
    (picture,) = frames_in(film, range(index, index + 1), dpi)
    buffer = io.BytesIO()
    if kind == "webp":
        picture.save(buffer, format="webp", quality=QUALITY)
    else:
        picture.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def frames_in(film: Film, indices: range, dpi: int) -> Iterator[Image]:
    """The instants as RGB images."""
    from PIL import Image

    with look():
        figure = new_figure(*film.size)
        figure.set_dpi(dpi)
        figure.set_facecolor(PAPER)
        turn = film.begin(figure)
        canvas: Any = figure.canvas
        for index in indices:
            turn(index)
            if not film.draws:
                canvas.draw()
            yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
