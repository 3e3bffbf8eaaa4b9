"""`stlc help`: the help of the program or of a command."""

from __future__ import annotations

from typing import Annotated

import typer

from stlc.cli.framework.program import command


@command("stlc help", "stlc help check", "stlc help runs list")
def help_(
    name: Annotated[
        list[str] | None, typer.Argument(metavar="COMMAND", help="A command; all if none.")
    ] = None,
) -> None:
    """Show the help of the program or of a command, as --help does."""
    from stlc.cli.framework.app import PROGRAM

    raise typer.Exit(PROGRAM.run([*(name or ()), "--help"]))
