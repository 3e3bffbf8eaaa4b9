"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.framework.completion import requirement_names, run_names
from stlc.diagnostics import Diagnostic, UsageError

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on the standard output.")]
SystemOption = Annotated[
    str | None,
    typer.Option(
        "--system",
        "-s",
        metavar="FILE",
        help="The system: as given, beside the spec, in systems/, in examples/, or installed.",
    ),
]
RunArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN",
        help="A run's folder, number, words, spec (its name or file), or latest.",
        autocompletion=run_names,
    ),
]
RequireOption = Annotated[
    list[str] | None,
    typer.Option(
        "--require",
        metavar="NAME",
        help="This requirement only; repeatable.",
        autocompletion=requirement_names,
    ),
]
SpecsArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="FILE…", help="Specifications, folders, or -; the current folder if none."),
]
SeedsOption = Annotated[str, typer.Option("--seeds", metavar="SEEDS", help="Such as 0..9 or 0,3.")]
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
RunsOption = Annotated[Path, typer.Option("--runs", metavar="DIR", help="Folder of all runs.")]
PicturesOption = Annotated[bool, typer.Option(help="Draw pictures and the report.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change a constant of the spec or a key of the system."),
]


def parse_overrides(pairs: Sequence[str] | None) -> dict[str, str]:
    """`["T_red=3 s"]` as `{"T_red": "3 s"}`.

    Raises:
        UsageError: U101, an entry is not `NAME=VALUE`, or a name is given twice.
    """
    values: dict[str, str] = {}
    for pair in pairs or ():
        name, sign, value = (part.strip() for part in pair.partition("="))
        if not (name and sign and value):
            finding = Diagnostic(
                "U101", f"`--set {pair}` is not of the form NAME=VALUE", help=("write it as --set T_red=3s",)
            )
            raise UsageError(finding)
        if name in values:
            raise UsageError(Diagnostic("U101", f"`--set {name}=…` is given twice"))
        values[name] = value
    return values


SPEC_SUFFIXES = (".stl", ".stlc")
STDIN = "-"


def spec_files(names: Sequence[str]) -> tuple[str, ...]:
    """The specification files, in order and without duplicates; a folder stands for all files below it.

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
    found = sorted(
        path for path in folder.rglob("*") if path.suffix in SPEC_SUFFIXES and _shown(path, folder)
    )
    if not found:
        raise UsageError(Diagnostic("U102", f"there is no specification in `{name}`"))
    yield from map(str, found)


def _shown(path: Path, folder: Path) -> bool:
    """True if no part of the path below the folder is hidden."""
    return path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
