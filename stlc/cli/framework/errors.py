"""Conversion of the exceptions of all commands into messages and exit codes."""

from __future__ import annotations

import errno
import sys
import traceback
from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer

from stlc.cli.framework.help import MOVED_OPTIONS
from stlc.cli.framework.output import Document, show_diagnostics
from stlc.diagnostics import MissingError, StlcError, os_reason, usage
from stlc.extras import absent

INTERNAL_ERROR = 70
INTERRUPTED = 130
TERMINATED = 143

_NO_WRITING = frozenset(
    {
        *(errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG, errno.EIO),
        *(errno.EMFILE, errno.EEXIST),
    }
)
_NO_FILE = frozenset({errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP})


class BugError(StlcError):
    """An internal error of stlc; a crash report is written for it."""

    exit_code = INTERNAL_ERROR


def report(error: BaseException, argv: Sequence[str]) -> int:
    """Print an error as a message or as a JSON document, and return the exit code of the program.

    An error that stlc does not know is reported as a bug, with a crash report. For a closed pipe, nothing is
    printed and the exit code is 0.
    """
    match error:
        case SystemExit() if isinstance(error.__context__, BrokenPipeError):
            return 0  # the reader closed the pipe
        case SystemExit(code=int() as code):
            return _stopped(code, argv)
        case SystemExit(code=code):
            return 0 if code is None else 1
        case KeyboardInterrupt():
            return _stopped(INTERRUPTED, argv)
        case typer.Abort() if not isinstance(error.__cause__, EOFError):
            return _stopped(INTERRUPTED, argv)
    known = _known(error)
    if known is None:
        headline = "".join(traceback.format_exception_only(error)).strip().splitlines()[-1]
        path = _write_report(error, argv)
        note = "no crash report could be written" if path is None else f"the crash report is {path}"
        advice = () if path is None else ("report it with that file",)
        known = BugError.of("B001", f"a bug in stlc: {headline}", note=(note,), help=advice)
    if wants_json(argv):
        Document(_schema(argv), known.exit_code, known.diagnostics).print()
    else:
        show_diagnostics(known.diagnostics)
    return known.exit_code


def _stopped(code: int, argv: Sequence[str]) -> int:
    """Return the exit code `code` of a command that ended early, for example because of Ctrl-C.

    If the command was interrupted and its options ask for JSON, a JSON document is printed.
    """
    if code in (INTERRUPTED, TERMINATED) and wants_json(argv):
        Document(_schema(argv), code).print()
    return code


def wants_json(argv: Sequence[str]) -> bool:
    """True if the options ask for a JSON document: `--json` or `--format json`."""
    options = list(argv[: argv.index("--")] if "--" in argv else argv)
    joined = {f"{option}={value}" for option, value in pairwise([*options, ""])}
    return bool({"--json", "--format=json"} & ({*options} | joined))


def _schema(argv: Sequence[str]) -> str:
    """Name of the JSON Schema of a command's output, such as `check/1`.

    A command without a result has `stlc/1`, the schema of the keys that all commands share.
    """
    from stlc.cli.framework.results import RESULTS

    return f"{argv[0]}/1" if argv and argv[0] in RESULTS else "stlc/1"


def _known(error: BaseException) -> StlcError | None:
    """Return an StlcError that describes `error`, an error of another library or of the operating system.

    An StlcError is returned unchanged. None means that the error is a bug of stlc.
    """
    match error:
        case StlcError():
            return error
        case OSError():
            return _from_system(error)
        case MemoryError():
            return MissingError.of("R202", "there is not enough memory")
        case ModuleNotFoundError():
            return absent(error)
    if callable(getattr(error, "format_message", None)):
        return _usage(error)
    return None


def _from_system(error: OSError) -> StlcError | None:
    reason = os_reason(error)
    place = f" `{error.filename}`" if error.filename is not None else ""
    if error.errno in _NO_WRITING:
        return MissingError.of("R201", f"cannot use{place or ' a file'}: {reason}")
    if error.errno in _NO_FILE and place:
        return usage(f"cannot open{place}: {reason}", code="U102")
    return None


def _usage(error: BaseException) -> StlcError:
    """Return the error U101 for an error in the command line that typer reports.

    The error classes of typer are not public, so the error is recognised by its methods.
    """
    message = str(error.format_message()).strip().rstrip(".")  # type: ignore[attr-defined]
    message = message.replace(": Value error, ", ": ")  # pydantic's prefix of messages of validators
    context: Any = getattr(error, "ctx", None)
    command = getattr(context, "command_path", "stlc")
    lowered = message[:1].lower() + message[1:] if message[1:2].islower() else message
    former = str(getattr(error, "option_name", ""))
    present = MOVED_OPTIONS.get(former, former)
    if present != former and any(present in param.opts for param in context.command.params):
        return usage(f"{former} is now called {present}", f"{command} {present} …")
    return usage(lowered, f"{command} --help")


def _write_report(error: BaseException, argv: Sequence[str]) -> Path | None:
    import tempfile

    from stlc.provenance import hardware, versions

    stamp = datetime.now().astimezone()
    lines = [
        f"time      {stamp.isoformat(timespec='seconds')}",
        f"command   stlc {' '.join(argv)}",
        f"folder    {Path.cwd()}",
        f"python    {sys.version}",
        f"versions  {versions()}",
        f"hardware  {hardware()}",
        "",
        *(line.rstrip("\n") for line in traceback.format_exception(error)),
    ]
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix=f"stlc-crash-{stamp:%Y%m%d-%H%M%S}-", suffix=".txt", delete=False, encoding="utf-8"
        ) as file:
            file.write("\n".join(lines) + "\n")
    except OSError:
        return None
    return Path(file.name)
