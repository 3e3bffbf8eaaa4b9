"""Formats of trace files: the table `FORMATS`, and helper functions that the readers of files share.

A format is a module of this package and an entry of `FORMATS`, or a module of another package with an object
`FORMAT`, whose entry point is called like the suffix (`ELSEWHERE`). The module contains

- `read(path) -> Recording`;
- if the format has `writes` set: `write(path, trace)`;
- if the format has `chunked` set: `size(path) -> int`, the bytes of its numbers in memory (0: not readable in
  chunks), and `chunks(path, samples) -> Iterator[Recording]`.

The module imports optional libraries with `stlc.extras.needed`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from stlc.diagnostics import StlcError, TraceError, usage
from stlc.extras import needed
from stlc.registry import PackageRegistry

MAX_BYTES = 4_000_000_000
MAX_LETTERS = 64
"""Longer words are cut: an array of words is as wide as the longest. Names of enum members are shorter."""
_ROOM = 500_000_000
_RATIO = 200
"""A compressed file may expand to `_ROOM` bytes, or this multiple of its size; sensor logs need a tenth."""


@dataclass(frozen=True, slots=True)
class Format:
    """A format of trace files.

    Attributes:
        module: name of the module in this package; of another package, its dotted name.
        suffixes: suffixes of its files, in lower case; files are written with the first one.
        package: module of an optional library that writes the format.
        writes: whether traces can be written in this format.
        chunked: whether files can be read a number of samples at a time.
        folder: whether a folder may be one trace.
    """

    module: str
    suffixes: tuple[str, ...]
    package: str = ""
    writes: bool = False
    chunked: bool = False
    folder: bool = False

    def require(self) -> None:
        """Raise NotInstalledError (R301) if the package that writes the format is not installed."""
        if self.package:
            needed(self.package)

    def function(self, name: str) -> Any:
        """Import the module of the format, and return its function `name`."""
        module = self.module if "." in self.module else f"{__package__}.{self.module}"
        return getattr(import_module(module), name)


FORMATS = (
    Format("npz", (".npz",), writes=True, chunked=True),
    Format("csv", (".csv", ".tsv", ".txt"), writes=True, chunked=True),
    Format("jsonl", (".jsonl", ".ndjson"), chunked=True),
    Format("parquet", (".parquet", ".pq"), "pyarrow", chunked=True),
    Format("mat", (".mat",)),
    Format("mcap", (".mcap",), "mcap", writes=True),
    Format("ulg", (".ulg",)),
    Format("mf4", (".mf4", ".mdf")),
    Format("bag", (".bag", ".db3"), folder=True),
)
ELSEWHERE: PackageRegistry[Format] = PackageRegistry(
    "trace format", "", "FORMAT", group="stlc.formats", accepts="stlc.trace.formats.registry:Format"
)
"""Formats of other packages (`Format`), by the suffix of their files without its dot."""
WRITTEN = tuple(each.suffixes[0] for each in FORMATS if each.writes)


def suffix_of(path: Path) -> str:
    """Suffix of a trace file in lower case, without a `.gz` behind it."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix == ".gz" else suffix


def format_of(path: Path) -> Format:
    """Return the format that the suffix of `path` indicates.

    A folder has a format of its own. For an unknown suffix, the first format of `FORMATS` is returned.

    Raises:
        PluginError: S206, the format is of another package and cannot be loaded.
    """
    if path.is_dir():
        return next(each for each in FORMATS if each.folder)
    suffix = suffix_of(path)
    own = (each for each in FORMATS if suffix in each.suffixes)
    return next(own, None) or (ELSEWHERE.get(suffix[1:]) if suffix[1:] in ELSEWHERE else FORMATS[0])


def suffixes() -> tuple[str, ...]:
    """Suffixes of all formats."""
    own = (suffix for each in FORMATS for suffix in each.suffixes)
    return *own, *(f".{name}" for name in ELSEWHERE)


def unreadable(path: Path | str, why: str, *, advice: str = "") -> TraceError:
    """Return the error E603: the file cannot be read, or is not safe to read; `advice` is a help."""
    return TraceError.of("E603", f"cannot read `{path}`: {why}", help=(advice,) if advice else ())


@contextmanager
def opened(path: Path) -> Iterator[None]:
    """Context in which system errors in opening a file become UsageError (U102)."""
    try:
        yield
    except OSError as error:
        why = (error.strerror or type(error).__name__).lower()
        raise usage(f"cannot read `{path}`: {why}", code="U102") from None


@contextmanager
def damage(path: Path) -> Iterator[None]:
    """Context in which the errors of a library on damaged files become TraceError (E603)."""
    try:
        yield
    except StlcError:
        raise
    except Exception as error:
        why = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise unreadable(path, f"it is damaged or of another format ({why[:100]})") from None


def room_for(path: Path) -> int:
    """Number of bytes to which a compressed file may expand at most."""
    return min(MAX_BYTES, max(_ROOM, _RATIO * path.stat().st_size))


def require_room(path: Path, size: int, *, chunk: bool = False) -> None:
    """Raise TraceError (E603) if a file, or a chunk of it, that unpacks to `size` bytes is too large."""
    most = room_for(path)
    if not 0 <= size <= most:
        fewer = "--chunk SAMPLES  reads fewer samples at a time"
        what, advice = ("a chunk", fewer) if chunk else ("it", "split it, or do not compress it")
        why = f"{what} unpacks to {size / 1e9:.1f} GB, more than {most / 1e9:.1f} GB"
        raise unreadable(path, why, advice=advice)
