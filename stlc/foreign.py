"""Python that a file names: its modules are imported here, and those of a run only by commands that drive."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

from stlc.diagnostics import RunError
from stlc.files import File, read_regular
from stlc.source import Span

_TEXT = "__stlc_text__"
"""Attribute of an imported module: path and content of its file."""
_DRIVING: ContextVar[bool] = ContextVar("driving", default=True)


@contextmanager
def driving(allowed: bool) -> Iterator[None]:
    """Context in which Python that the files of a run name is run, or refused (see `require_driving`)."""
    token = _DRIVING.set(allowed)
    try:
        yield
    finally:
        _DRIVING.reset(token)


def require_driving(place: Span | None) -> None:
    """Check that Python may be run that is named at `place` in a text.

    Raises:
        RunError: R111, the text is of a run, and the command does not drive.
    """
    if place is not None and place.source.root and not _DRIVING.get():
        message = "this command does not run the Python that a run names"
        help_ = ("if you trust the run: `stlc simulate` runs it, and `--python` where a command has it",)
        raise RunError.of("R111", message, place, label="names Python", help=help_)


class _TextLoader(SourceFileLoader):
    """Loader of a Python file that has been read; it reads and writes no compiled copy."""

    def __init__(self, name: str, path: Path, text: bytes) -> None:
        super().__init__(name, str(path))
        self.text = text

    def get_code(self, _fullname: str) -> CodeType:
        return self.source_to_code(self.text, self.path)


def module_at(path: Path, name: str, place: Span | None = None) -> ModuleType:
    """Import the Python file at `path` as the module `name`, which runs it, once while its text is the same.

    No compiled copy (`__pycache__`) is read or written beside it.

    Raises:
        RunError: R111, a run names the file at `place`, and the command does not drive.
        FileNotFoundError: there is no such file.
        ImportError: it is not a Python file.
        Exception: whatever the file raises.
    """
    require_driving(place)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file `{path}`")
    text, known = read_regular(path, File.MAX_BYTES), sys.modules.get(name)
    if known is not None and getattr(known, _TEXT, None) == (path, text):
        return known
    if path.suffix != ".py":
        raise ImportError(f"`{path}` is not a Python file")
    loader = _TextLoader(name, path, text)
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    setattr(module, _TEXT, (path, text))
    return module
