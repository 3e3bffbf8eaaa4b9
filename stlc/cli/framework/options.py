"""Options that several commands share, beside those of operations (`stlc.options`)."""

from __future__ import annotations

import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.framework.completion import run_names
from stlc.diagnostics import usage
from stlc.files import File

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on the standard output.")]
RunArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN",
        help="A run's folder, number, words, spec (its name or file), or latest.",
        autocompletion=run_names,
    ),
]
SpecsArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="FILE…", help="Specifications, folders, or -; the current folder if none."),
]
FailUnderOption = Annotated[
    float | None,
    typer.Option(
        "--fail-under",
        metavar="SHARE",
        min=0,
        max=1,
        help="Exit with 1 if a smaller share satisfies everything, else with 0.",
    ),
]


def require_separate(
    written: Iterable[tuple[str, Path | str | None]], read: Iterable[Path | str | None]
) -> None:
    """Check that no file that a command writes is one that it reads, or the file of another option.

    Args:
        written: options with the files that they name; None if an option is not given.
        read: files that the command reads.

    Raises:
        UsageError: U101, two of the files are one.
    """
    known = {_identity(path): "" for path in read}
    for option, path in written:
        file = _identity(path)
        if file is None:
            continue
        if file in known:
            what = f"also the file of `{known[file]}`" if known[file] else "a file that this command reads"
            raise usage(f"`{option} {path}` is {what}", "name another file")
        known[file] = option


def _identity(path: Path | str | None) -> object:
    """Key of a file, equal for all its paths; None for no file, such as a folder, a device or `-`."""
    if path is None or str(path) == File.STDIN:
        return None
    try:
        target = File(path).real
        found = target.stat()
    except FileNotFoundError:
        return target
    except (OSError, ValueError):  # no path: reading or writing it says why
        return None
    return (found.st_dev, found.st_ino) if stat.S_ISREG(found.st_mode) else None
