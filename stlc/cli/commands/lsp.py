"""`stlc lsp`: the language server, for editors."""

from __future__ import annotations

from typing import Annotated

import typer

from stlc.cli.framework.output import PULSE
from stlc.cli.framework.program import command


@command("stlc lsp")
def lsp(
    _stdio: Annotated[
        bool, typer.Option("--stdio", help="Over the standard input and output, which is the only way.")
    ] = True,
) -> None:
    """Serve an editor: findings, hover, completion, rename, format.

    Editors start this command and communicate with it by the language server protocol, over the standard
    input and output. It needs `pip install 'stlc[lsp]'`. See docs/editors.md for the setup of editors.
    """
    from stlc.editor.server import make_server

    with PULSE.doing(""):  # waits for the editor
        make_server().start_io()
