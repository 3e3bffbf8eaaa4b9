"""Of several processes that train together one speaks."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

import typer

from stlc.cli.framework.output import show_diagnostics
from stlc.diagnostics import MissingError, StlcError

LOST = "R403"


@contextmanager
def one_voice() -> Iterator[None]:
    """Let the first rank of those that `torchrun` started speak; the others only of what is theirs alone.

    What is wrong with a specification all of them find; what a machine lacks perhaps one, which says so.
    """
    rank, local = (int(os.environ.get(name, "0")) for name in ("RANK", "LOCAL_RANK"))
    if rank == 0:
        yield
        return
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    except StlcError as error:
        lost = any(finding.code == LOST for finding in error.diagnostics)
        if not lost and (local == 0 or isinstance(error, MissingError)):
            show_diagnostics([finding.with_note(f"on rank {rank}") for finding in error.diagnostics])
        raise typer.Exit(error.exit_code) from error
