"""`stlc lsp`: the language server, for editors."""

from __future__ import annotations

from typing import Annotated

import typer

from stlc.cli.framework.options import describe


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        "lsp",
        help=describe(
            "Serve an editor: findings, hover, completion, rename, format.",
            "stlc lsp",
            note="Speaks the language server protocol over the standard input and output. Editors start it. "
            "Needs `pip install 'stlc[lsp]'`. docs/editors.md says how to set up which.",
        ),
    )(lsp)


def lsp(
    _stdio: Annotated[
        bool, typer.Option("--stdio", help="Over the standard input and output, which is the only way.")
    ] = True,
) -> None:
    """Serve until the editor says that it is done."""
    from stlc.editor.server import make_server

    make_server().start_io()
