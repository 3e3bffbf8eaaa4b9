"""`stlc fmt`: the standard layout of specifications."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import unified_diff
from typing import Annotated

import typer

from stlc.cli.framework.options import STDIN, JsonOption, SpecsArgument, spec_files
from stlc.cli.framework.output import emit, emit_json, say, show_diagnostics
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, SpecError

DIFFERS, INVALID = 1, 3


@dataclass(frozen=True, slots=True)
class _Formatted:
    """A file, its text before and after."""

    name: str
    before: str
    after: str

    @property
    def differs(self) -> bool:
        """True if formatting changes the text."""
        return self.before != self.after


@command("stlc fmt specs/traffic.stl --check", "stlc fmt specs --diff", "stlc fmt - < specs/traffic.stl")
def fmt(
    files: SpecsArgument = None,
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; exit with 1 if a file differs.")
    ] = False,
    diff: Annotated[bool, typer.Option("--diff", help="Write nothing; print what would change.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Format specifications in the standard layout.

    Meaning, comments and blank lines between groups are kept. Operators of other tools (G, &&, =>, □)
    become those of the language; parentheses are added where other tools parse a formula differently.
    Formatting is idempotent.
    Exit code: 0, or 1 if --check or --diff found a difference.
    """
    names = spec_files(files or ["."])
    findings: list[Diagnostic] = []
    results = [result for name in names if (result := _format(name, findings))]
    changed = [result for result in results if result.differs]
    dry = check or diff
    if not dry:
        _write(results, as_json=as_json)
    code = INVALID if findings else DIFFERS if dry and changed else 0
    if as_json:
        entry = {"files": names, "changed": [result.name for result in changed], "written": not dry}
        entry |= {"diff": "".join(map(_diff, changed))} if diff else {}
        emit_json("fmt/1", ok=code == 0, exit_code=code, diagnostics=findings, result=entry)
    else:
        show_diagnostics(findings)
        _tell(results, changed, check=check, diff=diff)
    raise typer.Exit(code)


def _format(name: str, findings: list[Diagnostic]) -> _Formatted | None:
    """Both texts of a file; None, with its findings, on syntax errors."""
    from stlc.files import read_source
    from stlc.grammar.format.format import format_text

    try:
        source = read_source(name)
        return _Formatted(name, source.text, format_text(source))
    except SpecError as error:
        findings += error.diagnostics
        return None


def _write(results: Sequence[_Formatted], *, as_json: bool) -> None:
    from stlc.files import write_atomic

    for result in results:
        if result.name == STDIN:
            if not as_json:
                sys.stdout.write(result.after)
        elif result.differs:
            write_atomic(result.name, result.after)


def _tell(results: Sequence[_Formatted], changed: Sequence[_Formatted], *, check: bool, diff: bool) -> None:
    """Print which files differ, and how many do not."""
    if diff and changed:
        emit("".join(map(_diff, changed)).rstrip("\n"))
    verb = "would change" if check or diff else "changed"
    for result in changed:
        if result.name != "-":
            say(f"{verb} {result.name}")
    alike = len(results) - len(changed)
    if alike:
        say(f"{alike} {'file' if alike == 1 else 'files'} left as {'it is' if alike == 1 else 'they are'}")


def _diff(result: _Formatted) -> str:
    """The changes as a unified diff."""
    before, after = (text.splitlines(keepends=True) for text in (result.before, result.after))
    lines = unified_diff(before, after, f"{result.name}", f"{result.name} (formatted)")
    return "".join(
        line if line.endswith("\n") else f"{line}\n\\ No newline at end of file\n" for line in lines
    )
