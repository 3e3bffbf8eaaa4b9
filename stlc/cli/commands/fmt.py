"""`stlc fmt`: the standard layout of specifications."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import unified_diff
from typing import Annotated, ClassVar

import typer

from stlc.cli.framework.options import JsonOption, SpecsArgument
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, SpecError
from stlc.files import File

DIFFERS, INVALID = 1, 3


@dataclass(frozen=True, slots=True)
class FormattedFiles:
    """Files that were formatted, those that changed, and whether they were written; else the difference."""

    JSON: ClassVar = "files changed written diff??"

    files: Sequence[str]
    changed: Sequence[str]
    written: bool
    diff: str | None = None


@dataclass(frozen=True, slots=True)
class _Formatted:
    """Text of a file before and after formatting."""

    name: str
    before: str
    after: str


@command("stlc fmt specs/traffic.stl --check", "stlc fmt specs --diff", "stlc fmt - < specs/traffic.stl")
def fmt(
    files: SpecsArgument = None,
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; exit with 1 if a file differs.")
    ] = False,
    diff: Annotated[bool, typer.Option("--diff", help="Write nothing; print what would change.")] = False,
    json: JsonOption = False,
) -> Answer[FormattedFiles]:
    """Format specifications in the standard layout.

    The meaning, the comments, and blank lines between groups are kept. Operators of other tools (G, &&, =>,
    □) are replaced by those of the language. Parentheses are added where other tools parse a formula
    differently. Formatting a second time changes nothing. Exit code: 0, or 1 if --check or --diff found a
    difference.
    """
    from stlc.grammar.format.format import format_text

    names = File.specs(files or ["."])
    findings: list[Diagnostic] = []
    results = []
    for name in names:
        try:
            source = File(name).read()
            results.append(_Formatted(name, source.text, format_text(source)))
        except SpecError as error:
            findings += error.diagnostics
    changed = [result for result in results if result.before != result.after]
    dry = check or diff
    for result in () if dry else results:
        if result.name == File.STDIN:
            sys.stdout.write("" if json else result.after)
        elif result in changed:
            File(result.name).write(result.after)

    text = "".join(map(_diff, changed)) if diff else None
    record = FormattedFiles(names, [result.name for result in changed], not dry, text)

    def show() -> None:
        show_diagnostics(findings)
        _tell(record, len(results) - len(changed))

    return Answer(record, show, INVALID if findings else DIFFERS if dry and changed else 0, findings)


def _tell(record: FormattedFiles, alike: int) -> None:
    """Print the differences or the names of changed files, then `alike`, the number of unchanged files."""
    if record.diff:
        emit(record.diff.rstrip("\n"))
    for name in record.changed:
        if name != File.STDIN:
            say(f"{'changed' if record.written else 'would change'} {name}")
    if alike:
        say(f"{alike} {'file' if alike == 1 else 'files'} left as {'it is' if alike == 1 else 'they are'}")


def _diff(result: _Formatted) -> str:
    """Changes of a file as a unified diff."""
    before, after = (text.splitlines(keepends=True) for text in (result.before, result.after))
    lines = unified_diff(before, after, f"{result.name}", f"{result.name} (formatted)")
    return "".join(
        line if line.endswith("\n") else f"{line}\n\\ No newline at end of file\n" for line in lines
    )
