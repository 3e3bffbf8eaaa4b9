"""Output: results to the standard output, messages to the standard error.

A closed pipe (`stlc … | head`) is not an error: the remaining output is dropped; the exit code is unchanged.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TextIO, TypeVar, cast

from stlc.activity import PULSE
from stlc.diagnostics import Diagnostic, Notice
from stlc.escape import screen, visible
from stlc.jsontext import dumps
from stlc.version import __version__

if TYPE_CHECKING:
    from rich.console import Console

R = TypeVar("R", covariant=True)

ColorMode = Literal["auto", "always", "never"]

WIDEST = 80
"""Largest width in characters that a cell can give its column; a wider cell sticks out."""

COLOR: ContextVar[ColorMode] = ContextVar("stlc_color", default="auto")
QUIET: ContextVar[bool] = ContextVar("stlc_quiet", default=False)
"""True if remarks and progress are suppressed."""


def emit(text: str, *, styled: bool = False) -> None:
    """Write `text` and a line break to the standard output.

    On a terminal, control characters other than line breaks and tabs are replaced. A `styled` text may
    contain colour codes; then its caller must have applied `stlc.escape.visible` to all names that come from
    files.
    """
    _write(sys.stdout, screen(text, styled=styled))


def say(text: str) -> None:
    """Write a line to the standard error; with `--quiet`, write nothing."""
    if not QUIET.get():
        _write(sys.stderr, visible(text))


@dataclass(frozen=True, slots=True)
class Document:
    """JSON document of a command.

    Attributes:
        schema: name and major number of its JSON Schema, such as "check/1".
        exit_code: exit code of the command.
        diagnostics: errors and warnings.
        result: record of the command; numbers that are not finite are written as texts.
    """

    JSON: ClassVar = "stlc schema ok exit_code diagnostics result"

    schema: str
    exit_code: int
    diagnostics: Sequence[Diagnostic] = ()
    result: Any = None

    @property
    def stlc(self) -> str:
        """Version of stlc."""
        return __version__

    @property
    def ok(self) -> bool:
        """True if the command succeeded and its answer is positive, such as "satisfied"."""
        return self.exit_code == 0

    def print(self) -> None:
        """Write the document to the standard output."""
        emit(dumps(self, indent=2))


@dataclass(frozen=True, slots=True)
class Answer(Generic[R]):
    """Outcome of a command, printed as a JSON document or as text.

    Attributes:
        result: record printed with `--json`.
        show: function that prints the outcome as text.
        code: exit code.
        diagnostics: errors and warnings in the JSON document.
    """

    result: R
    show: Callable[[], object]
    code: int = 0
    diagnostics: Iterable[Diagnostic] = ()

    def print(self, schema: str, *, as_json: bool) -> int:
        """Print the outcome as text or, if `as_json`, as a JSON document; return the exit code.

        `schema` names the JSON Schema of the document, such as "check/1".
        """
        if as_json:
            Document(schema, self.code, tuple(self.diagnostics), self.result).print()
        else:
            self.show()
        return self.code


def show_diagnostics(diagnostics: Sequence[Diagnostic]) -> None:
    """Print findings to the standard error, as text with the source lines that they concern."""
    from stlc.cli.framework.render import render_text

    if diagnostics:
        text = render_text(tuple(diagnostics), color=wants_color(sys.stderr)).rstrip("\n")
        _write(sys.stderr, screen(text, styled=True))


@contextmanager
def noticing() -> Iterator[None]:
    """Context in which warnings about the machine (`stlc.diagnostics.Notice`) are printed, each only once."""
    shown: set[str] = set()
    others = warnings.showwarning

    def show(message: Warning | str, *rest: Any, **options: Any) -> None:
        if not isinstance(message, Notice):
            others(message, *rest, **options)
        elif str(message) not in shown:
            shown.add(str(message))
            show_diagnostics([message.finding])

    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        warnings.showwarning = show
        yield


def wants_color(stream: TextIO) -> bool:
    """True if colour codes may be written to `stream`.

    The option `--color always` or `--color never` decides. Without it, there is no colour if `NO_COLOR` is
    set, or if `stream` is not a terminal.
    """
    mode = COLOR.get()
    if mode != "auto":
        return mode == "always"
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return False
    return stream.isatty()


def console(*, stderr: bool = False) -> Console:
    """Return a rich console without markup, for results or, with `stderr`, for messages.

    Lines are as wide as the terminal, or 120 columns wide in a pipe or a file.
    """
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    colored = wants_color(stream)
    return Console(
        file=cast(TextIO, _Noted(stream)),
        force_terminal=colored or None,
        no_color=not colored,
        highlight=False,
        markup=False,
        quiet=stderr and QUIET.get(),
        width=None if stream.isatty() else 120,
        soft_wrap=not stream.isatty(),
    )


def table(rows: Sequence[Sequence[str]], *, header: Sequence[str] = (), indent: str = "  ") -> str:
    """Lay out rows of cells as a text table with two spaces between columns.

    Each line begins with `indent`. Numbers, and values with a sign and a unit, are right-aligned.
    """
    lines = [tuple(map(visible, row)) for row in ([header, *rows] if header else rows)]
    if not lines:
        return ""
    count = max(len(line) for line in lines)
    widths = [
        min(max((len(line[i]) for line in lines if i < len(line)), default=0), WIDEST) for i in range(count)
    ]
    return "\n".join(
        (indent + "  ".join(_cell(cell, width) for cell, width in zip(line, widths, strict=False))).rstrip()
        for line in lines
    )


_NUMBER = re.compile(r"[+-]?[\d,]*\.?\d+(?:e[+-]?\d+)?|[+-]inf")


def _cell(text: str, width: int) -> str:
    number, _, unit = text.partition(" ") if text[:1] in ("+", "-") else (text, "", "")
    is_number = " " not in unit and _NUMBER.fullmatch(number) is not None
    return text.rjust(width) if is_number else text.ljust(width)


class _Noted:
    """Output stream that removes the progress message (`PULSE`) from the terminal before each output."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Remove the progress message, then write a text to the stream; return the number of characters."""
        PULSE.note()
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _write(stream: TextIO | None, text: str) -> None:
    if stream is None:  # closed by the caller: stlc … >&-
        return
    PULSE.note()
    with tolerate_closed(stream):
        try:
            stream.write(text + "\n")
        except UnicodeEncodeError:
            encoding = stream.encoding or "ascii"
            stream.write(text.encode(encoding, "replace").decode(encoding) + "\n")
        stream.flush()


@contextmanager
def tolerate_closed(stream: TextIO) -> Iterator[None]:
    """Context in which a closed pipe is not an error: all later output to `stream` is dropped."""
    try:
        yield
    except BrokenPipeError:
        silence(stream)


def silence(stream: TextIO) -> None:
    """Drop buffered and future output of a stream."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
