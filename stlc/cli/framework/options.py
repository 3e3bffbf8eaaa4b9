"""Options that several commands share, and how their help is laid out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.framework.completion import requirement_names, run_names
from stlc.cli.framework.output import emit
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
RunsOption = Annotated[Path, typer.Option("--runs", metavar="DIR", help="Folder of all runs.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change a constant of the spec or a key of the system."),
]


def describe(sentence: str, *examples: str, note: str = "") -> str:
    """The help of a command: one sentence, examples as they are typed, then what else is to be known."""
    shown = "\b\nExample:\n" if len(examples) == 1 else "\b\nExamples:\n"
    lines = "\n".join(f"  {example}" for example in examples)
    return "\n\n".join(part for part in (sentence, shown + lines, note) if part)


def only_help(context: typer.Context) -> None:
    """A group of commands without one of them: its help and exit code 2, as for `stlc` alone."""
    if context.invoked_subcommand is None:
        emit(context.get_help())
        raise typer.Exit(2)


def parse_overrides(pairs: Sequence[str] | None) -> dict[str, str]:
    """`["T_red=3 s"]` as `{"T_red": "3 s"}`.

    Raises:
        UsageError: U101, an entry is no `NAME=VALUE`, or a name is given twice.
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
