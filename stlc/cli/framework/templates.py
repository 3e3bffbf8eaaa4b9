"""The texts that `stlc init` and `stlc new` begin with."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.diagnostics import Diagnostic, UsageError
from stlc.files import write_atomic
from stlc.grammar.show.expressions import own_name

if TYPE_CHECKING:
    from stlc.dynamics.declaration.decl import SystemDecl
    from stlc.signature import Column

FOLDER = Path(__file__).parents[2] / "templates"

ATTRIBUTES = "*.stl linguist-language=Text diff\n"
EDITOR = '{\n  "files.associations": {"*.stl": "stlc"}\n}\n'
IGNORED = "runs/\n__pycache__/\n"

_NAME = re.compile(r"[^\W\d]\w*")


def read_template(name: str) -> str:
    """The text of a template."""
    return (FOLDER / name).read_text(encoding="utf-8")


def checked_name(name: str) -> str:
    """A name that a specification or a system can have.

    Raises:
        UsageError: U101, it is no name of the language.
    """
    from stlc.grammar.words import BUILT_IN, RESERVED

    if not _NAME.fullmatch(name) or name in RESERVED or name in BUILT_IN:
        advice = ("letters, digits and `_`, none of the words of the language",)
        raise UsageError(Diagnostic("U101", f"`{name}` cannot be a name", help=advice))
    return name


def spec_text(name: str, system: SystemDecl | None, reference: str) -> str:
    """A specification to begin with; of a system with a `signal` line for each state.

    Args:
        name: of the specification.
        system: whose states it speaks about.
        reference: the path of that system as the specification writes it.
    """
    if system is None:
        signals, predicate = "signal x [m] in [-5, 5]", "x < 4 m"
    else:
        columns = system.signature.columns
        signals = "\n".join(map(_signal, columns))
        predicate = _predicate(columns[0])
    return read_template("spec.stl").format(
        name=name,
        system=f'system "{reference}"\n' if reference else "",
        signals=signals,
        requirement="stays",
        predicate=predicate,
    )


def _signal(column: Column) -> str:
    role = column.role if column.role in ("input", "output", "state", "env") else "state"
    head = f"{role} signal {own_name(column.name)}"
    if column.kind == "bool":
        return f"{head} : bool"
    if column.labels:
        members = ", ".join(f"{own_name(label)} = {value:g}" for label, value in column.labels)
        kind = column.name.capitalize()
        return f"enum {kind} {{ {members} }}\n{head} : {kind}"
    unit = f" [{column.unit}]" if column.unit.text else ""
    limits = "" if column.low is None or column.high is None else f" in [{column.low:g}, {column.high:g}]"
    return f"{head}{unit}{limits}"


def _predicate(column: Column) -> str:
    if column.kind == "bool":
        return own_name(column.name)
    if column.labels:
        return f"{own_name(column.name)} == {own_name(column.labels[0][0])}"
    high = 0.0 if column.high is None else column.high
    return f"{own_name(column.name)} <= {high:g}" + (f" {column.unit}" if column.unit.text else "")


def write_new(path: Path, text: str, *, force: bool) -> None:
    """Write a file that is not there yet.

    Raises:
        UsageError: U101, it is there and `force` is not given.
    """
    require_new([path], force=force)
    write_atomic(path, text)


def require_new(paths: list[Path], *, force: bool) -> None:
    """Raise UsageError (U101) if one of the files is there already, unless `force` is given."""
    there = [str(path) for path in paths if path.exists()]
    if there and not force:
        verb = "is" if len(there) == 1 else "are"
        finding = Diagnostic("U101", f"{', '.join(there)} {verb} there already", help=("overwrite: --force",))
        raise UsageError(finding)
