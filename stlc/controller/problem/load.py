"""Loading of tasks from a specification file and a system file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stlc.controller.problem.task import Task
from stlc.diagnostics import Diagnostic, UsageError
from stlc.dynamics.model.system import System
from stlc.files import find_spec, find_system, read_source
from stlc.grammar.parse.parser import parse

if TYPE_CHECKING:
    from collections.abc import Mapping


def load_task(
    spec: Path | str, system: Path | str | None = None, overrides: Mapping[str, str] | None = None
) -> Task:
    """Load a specification and a system, and compile the specification for the system.

    Args:
        spec: specification file, searched by `find_spec`.
        system: system file, searched by `find_system`; by default the one that the specification names.
        overrides: constants of the specification and keys of the system file to change, name -> text.

    Raises:
        UsageError: U101, no system is named; U102, there is no such file.
        SpecError: the specification is invalid or does not fit the system.
        SystemFileError: the system file is invalid.
    """
    path = find_spec(Path(spec))
    parsed = parse(read_source(path))
    wanted = system if system is not None else parsed.system
    if wanted is None:
        help_ = ("--system FILE", 'or a line `system "FILE"` in the specification')
        raise UsageError(Diagnostic("U101", f"`{path}` names no system", help=help_))
    changed = dict(overrides or {})
    loaded = System.load(find_system(str(wanted), path), changed)
    return Task.of(parsed, loaded, overrides=changed)
