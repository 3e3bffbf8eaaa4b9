"""`stlc lsp`: the language server, for editors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stlc.activity import PULSE
from stlc.cli.framework.program import command


@command("stlc lsp", "stlc lsp --trace drive.csv")
def lsp(
    _stdio: Annotated[
        bool, typer.Option("--stdio", help="Over the standard input and output, which is the only way.")
    ] = True,
    trace: Annotated[
        Path | None,
        typer.Option("--trace", metavar="FILE", help="Show what this recording does not test, too."),
    ] = None,
) -> None:
    """Serve an editor: findings, hover, completion, rename, format.

    Editors start this command and communicate with it by the language server protocol, over the standard
    input and output. It needs the extra `lsp`. See docs/editors.md for the setup of editors.
    """
    from stlc.editor.server import make_server

    with PULSE.doing(""):  # waits for the editor
        make_server(trace).start_io()
