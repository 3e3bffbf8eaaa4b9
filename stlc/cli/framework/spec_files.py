"""The specifications that a command line names: files, folders and the standard input."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from stlc.diagnostics import Diagnostic, UsageError

SUFFIXES = (".stl", ".stlc")
STDIN = "-"


def spec_files(names: Sequence[str]) -> tuple[str, ...]:
    """The files that are meant, in order and once; a folder stands for all specifications below it.

    Raises:
        UsageError: U102, a folder without a specification; U101, nothing is named.
    """
    if not names:
        raise UsageError(Diagnostic("U101", "which file?", help=("a .stl file, a folder, or - for a pipe",)))
    return tuple(dict.fromkeys(path for name in names for path in _below(name)))


def _below(name: str) -> Iterator[str]:
    folder = Path(name)
    if name == STDIN or not folder.is_dir():
        yield name
        return
    found = sorted(path for path in folder.rglob("*") if path.suffix in SUFFIXES and _shown(path, folder))
    if not found:
        raise UsageError(Diagnostic("U102", f"there is no specification in `{name}`"))
    yield from map(str, found)


def _shown(path: Path, folder: Path) -> bool:
    """Whether no part of the path below the folder is hidden."""
    return path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
