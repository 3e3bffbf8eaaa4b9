"""Pictures one after the other as a GIF, with one palette for all of them."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Sequence

    from PIL.Image import Image

COLOURS = 96
SAMPLED = 8
"""Pictures that the palette is taken from, the first and the last among them."""
NARROWEST = 160  # pixels


def fitting(pictures: Sequence[Image], milliseconds: int, max_bytes: int) -> bytes:
    """`pictures` as a GIF, made smaller in width until it has at most `max_bytes`."""
    data = encoded(pictures, milliseconds)
    while len(data) > max_bytes and pictures[0].width > NARROWEST:
        factor = max(0.6, 0.95 * (max_bytes / len(data)) ** 0.5)
        size = (round(pictures[0].width * factor), round(pictures[0].height * factor))
        pictures = [picture.resize(size) for picture in pictures]
        data = encoded(pictures, milliseconds)
    return data


def encoded(pictures: Sequence[Image], milliseconds: int) -> bytes:
    """`pictures` as a GIF that repeats for ever; the palette is taken from a few of them."""
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
    """The colours that cover most, exactly (white paper stays white), then those that lack most.

    A colour lacks the more, the farther it is from those that are there and the more often it occurs: a dot
    of a legend, or a line that was violated, keeps its own however small it is.
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
    """Squared distances of `colours` (many, 3) from `one`."""
    return np.asarray(((colours - one) ** 2).sum(1))
