"""Pictures one after the other as a GIF, with one palette for all of them."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from PIL.Image import Image

COLOURS = 64
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
