"""Parts of readers of tables with one line per sample: bytes and lines of text files, and their columns."""

from __future__ import annotations

import codecs
import gzip
import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

import numpy as np

from stlc.diagnostics import TraceError
from stlc.source import Source, Span
from stlc.trace.formats.registry import opened, room_for, unreadable

GROUPS = ("trace", "agent")
"""Names of columns that give the trace of each line."""
MAX_BYTES = 1_000_000_000
MAX_LINE = 20_000_000
_BLOCK = 1 << 20
_GZIP = b"\x1f\x8b"


def size(path: Path) -> int:
    """Size of the unpacked file in bytes, as an estimate of the memory that its numbers need."""
    with opened(path), path.open("rb") as file:
        packed = file.read(2) == _GZIP
        end = file.seek(-4, io.SEEK_END) + 4 if packed else file.seek(0, io.SEEK_END)
        return max(end, int.from_bytes(file.read(4), "little")) if packed else end


@contextmanager
def _unpacked(path: Path) -> Iterator[IO[bytes]]:
    with opened(path), path.open("rb") as file:
        packed = file.read(2) == _GZIP
        file.seek(0)
        if not packed:
            yield file
            return
        try:
            with gzip.GzipFile(fileobj=file) as content:
                yield cast("IO[bytes]", content)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise unreadable(path, f"it is damaged ({error})") from None


def unpacked(path: Path) -> bytes:
    """Return the bytes of a file, unpacked if it is a gzip file.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, it is too large, or damaged.
    """
    most = min(MAX_BYTES, room_for(path)) if path.is_file() else 0
    with _unpacked(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        advice = "save it as `.npz`, or  --chunk SAMPLES  reads it in pieces"
        raise unreadable(path, f"it is larger than {most / 1e9:.1f} GB", advice=advice)
    return data


def endless(path: Path) -> TraceError:
    """Return the error E603: the file has a line that is too long for a table."""
    return unreadable(path, f"it has a line of more than {MAX_LINE / 1e6:.0f} MB")


def utf8(path: Path, data: bytes) -> bytes:
    """Return a text in UTF-8, UTF-16 or Windows-1252 in UTF-8. Raises TraceError (E603) for other data."""
    if encoding := _utf16(data):
        data = data.decode(encoding, "replace").encode()
    if b"\0" in data:
        raise unreadable(path, "it is a binary file, not a table")
    if not data.isascii():
        try:
            data.decode()
        except UnicodeDecodeError:
            return data.decode("cp1252", "replace").encode()
    return data


def _utf16(data: bytes) -> str:
    """Name of the encoding UTF-16 in which a text begins; "" for other encodings."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    first = np.frombuffer(data[:64], dtype=np.uint8)
    low, high = (first[k::2] == 0 for k in (0, 1))
    if len(first) < 4 or low.mean() == high.mean():
        return ""
    return "utf-16-be" if low.mean() > 0.5 else "utf-16-le" if high.mean() > 0.5 else ""


def text_lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a text file in UTF-8, or in another encoding; every line end is a line feed.

    Raises UsageError (U102) and TraceError (E603).
    """
    with _unpacked(path) as file:
        encoding = _utf16(file.read(64))
        file.seek(0)
        text = io.TextIOWrapper(file, encoding or "latin-1", errors="replace")  # every line end becomes `\n`
        rest = b""
        while block := text.read(_BLOCK):
            *lines, rest = io.BytesIO(rest + block.encode("utf-8" if encoding else "latin-1"))
            yield from lines
            if len(rest) > MAX_LINE:
                raise endless(path)
        if rest:
            yield rest


def place(path: Path, above: int, text: str, start: int, end: int) -> Span:
    """Return the location of the characters from `start` to `end` of a text with `above` lines before it."""
    return Source(str(path), "\n" * above + text).span(above + start, above + end)
