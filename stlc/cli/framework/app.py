"""The program `stlc`: its commands, the options that stand before or after them, and `main`.

Nothing is imported here that a command does not need to be described: a command's body imports what it
works with, so `stlc --help` stays fast.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from types import FrameType
from typing import Annotated

import typer

from stlc.cli.bench import command as bench
from stlc.cli.check import command as check
from stlc.cli.commands import (
    compile,
    doctor,
    explain,
    export,
    fmt,
    init,
    lint,
    lsp,
    new,
    parse,
    plot,
    report,
    runs,
    schema,
    system,
)
from stlc.cli.framework.coercion import HELP_NAMES, spare_adapters
from stlc.cli.framework.errors import INTERRUPTED, TERMINATED
from stlc.cli.framework.errors import report as report_error
from stlc.cli.framework.options import describe, only_help
from stlc.cli.framework.output import COLOR, ColorMode, emit, noticing, silence
from stlc.cli.simulate import command as simulate
from stlc.cli.train import command as train
from stlc.version import __version__

app = typer.Typer(
    name="stlc",
    help=describe(
        "Train, check and guard controllers from Signal Temporal Logic requirements.",
        "stlc train specs/traffic.stl --system car.yaml --budget 60s",
        "stlc simulate --backup",
        "stlc check trace.npz",
    ),
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": list(HELP_NAMES)},
)
_DAILY = (train, simulate, check, explain, plot, report, runs, export)
_WRITING = (init, new, lint, fmt, parse, compile, system)
_OTHER = (lsp, schema, doctor, bench)
for group in (*_DAILY, *_WRITING, *_OTHER):
    group.register(app)


def _show_version(wanted: bool) -> None:
    if wanted:
        emit(f"stlc {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _global_options(
    context: typer.Context,
    color: Annotated[ColorMode, typer.Option("--color", help="Whether the output may be coloured.")] = "auto",
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_show_version)
    ] = False,
) -> None:
    COLOR.set(color)
    if not version:
        only_help(context)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    The one place where an exception becomes a message and an exit code; see `stlc.cli.framework.errors`.

    Args:
        argv: the arguments without the program's name; by default those of the process.
    """
    front, rest = _split(sys.argv[1:] if argv is None else argv)
    stopped: list[int] = []
    try:
        with _stoppable() as stopped, noticing():
            command = typer.main.get_command(_asked(rest[0] if rest else ""))
            spare_adapters(command)
            code = command.main(args=[*front, *rest], prog_name="stlc", standalone_mode=False)
    except BaseException as error:  # the boundary
        code = report_error(SystemExit(stopped[0]) if stopped else error, rest)
    _flush()
    return code if isinstance(code, int) else 0


def _asked(name: str) -> typer.Typer:
    """The program with this command alone: to describe all of them takes as long as to lint a file.

    The whole program if there is no such command.
    """
    alone = copy(app)
    alone.registered_commands = [
        each
        for each in app.registered_commands
        if each.callback is not None and name in (each.name, each.callback.__name__)
    ]
    alone.registered_groups = [
        each
        for each in app.registered_groups
        if each.typer_instance and each.typer_instance.info.name == name
    ]
    return alone if alone.registered_commands or alone.registered_groups else app


def _flush() -> None:
    """Leave nothing in the buffers: what cannot be written must not become a message of the interpreter."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (AttributeError, ValueError):
            continue
        except OSError:
            silence(stream)


def _split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The options of the whole program and the rest: `--color` may stand before or after the command."""
    front: list[str] = []
    rest: list[str] = []
    queue = list(arguments)
    while queue and queue[0] != "--":
        word = queue.pop(0)
        if word == "--color" and queue:
            front += [word, queue.pop(0)]
        elif word.startswith("--color="):
            front.append(word)
        else:
            rest.append(word)
    return front, [*rest, *queue]


@contextmanager
def _stoppable() -> Iterator[list[int]]:
    """While a command runs, Ctrl-C and SIGTERM unwind it, so that its `finally` blocks run.

    Gives the exit codes of what came: code in C that is interrupted may raise something else instead.
    """
    stopped: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        stopped.append(INTERRUPTED)
        raise KeyboardInterrupt

    def terminate(_number: int, _frame: FrameType | None) -> None:
        stopped.append(TERMINATED)
        raise SystemExit(TERMINATED)

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, terminate)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
