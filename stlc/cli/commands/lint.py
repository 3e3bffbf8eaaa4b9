"""`stlc lint`: errors and warnings in specifications."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stlc.cli.framework.options import STDIN, JsonOption, SpecsArgument, SystemOption, spec_files
from stlc.cli.framework.output import emit, emit_json, say, show_diagnostics, wants_color
from stlc.cli.framework.program import command
from stlc.diagnostics import CODES, Diagnostic, SpecError, StlcError, UsageError
from stlc.escape import sarif_message, uri, workflow_data, workflow_property
from stlc.source import Span
from stlc.version import __version__

if TYPE_CHECKING:
    from stlc.lint.lint import Selection, Surroundings
    from stlc.source import Source

Format = Literal["text", "json", "github", "sarif"]

CLEAN, FOUND, INVALID = 0, 1, 3


@dataclass(frozen=True, slots=True)
class _Job:
    """Options for every file."""

    selection: Selection
    system: str | None
    fix: bool


@dataclass(frozen=True, slots=True)
class _Result:
    """Findings and number of repairs."""

    files: tuple[str, ...]
    findings: tuple[Diagnostic, ...]
    fixed: int

    def code(self, *, strict: bool) -> int:
        """The exit code."""
        if any(finding.severity == "error" for finding in self.findings):
            return INVALID
        return FOUND if strict and self.findings else CLEAN


@command(
    "stlc lint specs/traffic.stl",
    "stlc lint specs --strict --format github",
    "stlc lint specs/traffic.stl --system car.yaml --fix",
)
def lint(
    files: SpecsArgument = None,
    fix: Annotated[bool, typer.Option("--fix", help="Repair what can be repaired, in place.")] = False,
    select: Annotated[
        str | None,
        typer.Option(metavar="CODES", help="Warnings to look for, such as W1,W304; ALL for every one."),
    ] = None,
    ignore: Annotated[str | None, typer.Option(metavar="CODES", help="Warnings to leave out.")] = None,
    format_: Annotated[Format, typer.Option("--format", help="How findings are written.")] = "text",
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 if there are warnings.")] = False,
    system: SystemOption = None,
    watch: Annotated[bool, typer.Option("--watch", help="Look again whenever a file changes.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Report errors and warnings in specifications.

    Syntax, types, units, parentheses, unused names, vacuous requirements; with --system also checks against
    the system. Exit code: 0 no errors, 1 warnings and --strict, 3 errors. `stlc explain CODE` says what a
    code means.
    """
    from stlc.lint.lint import Selection

    layout: Format = "json" if as_json else format_
    names = spec_files(files or ["."])
    job = _Job(Selection(_codes(select), _codes(ignore)), system, fix)
    if watch or fix:
        for option, wanted in (("--watch", watch), ("--fix", fix)):
            if wanted and STDIN in names:
                raise UsageError(Diagnostic("U101", f"`{option}` needs files, not the standard input"))
    if not watch:
        result = _look(names, job)
        code = result.code(strict=strict)
        _show(result, layout, code)
        raise typer.Exit(code)
    from stlc.cli.framework.watch import watch as watch_files

    def again() -> None:
        try:
            result = _look(names, job)
        except StlcError as error:
            show_diagnostics(error.diagnostics)
            return
        _show(result, layout, result.code(strict=strict))

    watch_files(names, again)


def _codes(text: str | None) -> tuple[str, ...]:
    return tuple(code.strip().upper() for code in (text or "").split(",") if code.strip())


def _look(names: Sequence[str], job: _Job) -> _Result:
    """Lint every file, after repairing it if requested."""
    from stlc.files import find_spec, read_source

    findings: list[Diagnostic] = []
    fixed = 0
    for name in names:
        try:
            source = read_source(name if job.fix else find_spec(name))
        except SpecError as error:
            findings += error.diagnostics
            continue
        count, found = _one(source, job)
        fixed += count
        findings += found
    return _Result(tuple(names), tuple(findings), fixed)


def _one(source: Source, job: _Job) -> tuple[int, Sequence[Diagnostic]]:
    """Number of repairs in a file, and the remaining findings."""
    from stlc.files import write_atomic
    from stlc.lint.lint import fix
    from stlc.lint.lint import lint as lint_text

    within = _surroundings(job.system, source)

    def look(text: Source) -> Sequence[Diagnostic]:
        return lint_text(text, within=within, selection=job.selection)

    if not job.fix:
        return 0, look(source)
    done = fix(source, look)
    if done.count:
        write_atomic(source.name, done.source.text)
    return done.count, done.findings


def _surroundings(system: str | None, source: Source) -> Surroundings | None:
    """Load the system to check against; None without one."""
    if system is None:
        return None
    from stlc.compile.ir.discretize import Grid
    from stlc.compile.pipeline import Purpose
    from stlc.dynamics.declaration.load import load_system_decl
    from stlc.files import find_system
    from stlc.lint.lint import Surroundings

    decl = load_system_decl(find_system(system, Path(source.name)))
    purpose: Purpose = "check" if decl.judges_by(Path(source.name)) else "train"
    return Surroundings(decl.interface(), Grid(decl.dt, decl.horizon), purpose)


def _show(result: _Result, layout: Format, code: int) -> None:
    """Print the findings; the layout never changes the exit code."""
    findings = result.findings
    match layout:
        case "json":
            entry = {"files": result.files, "findings": len(findings), "fixed": result.fixed}
            emit_json("lint/1", ok=code == CLEAN, exit_code=code, diagnostics=findings, result=entry)
        case "github":
            if findings:
                emit(github(findings))
        case "sarif":
            from stlc.jsontext import dumps

            emit(dumps(sarif(findings), indent=2))
        case _:
            if findings:
                from stlc.cli.framework.render import render_text

                emit(render_text(findings, color=wants_color(sys.stdout)).rstrip("\n") + "\n", styled=True)
            say(_summary(result))


def _summary(result: _Result) -> str:
    """The last line: numbers of findings and files, and the next step."""
    count = {"error": 0, "warning": 0}
    for finding in result.findings:
        count[finding.severity] += 1
    files = _several(len(result.files), "file")
    fixed = f"fixed {_several(result.fixed, 'finding')}; " if result.fixed else ""
    if not result.findings:
        return f"{fixed}{files}, nothing to say"
    found = ", ".join(_several(number, kind) for kind, number in count.items() if number)
    repairable = sum(finding.fix is not None for finding in result.findings)
    more = f"; {repairable} can be repaired: stlc lint --fix" if repairable else ""
    return f"{fixed}{found} in {files}{more}"


def _several(number: int, word: str) -> str:
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


# ------------------------------------------------------- findings for other programs

_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"


def github(findings: Iterable[Diagnostic]) -> str:
    """One `::error …` or `::warning …` line for each finding."""
    return "\n".join(map(_command, findings))


def _command(finding: Diagnostic) -> str:
    places = [f"title={workflow_property(finding.code)}"]
    if finding.span is not None:
        (line, column), (end_line, end_column) = _ends(finding.span)
        places += [
            f"file={workflow_property(finding.span.source.name)}",
            f"line={line}",
            f"endLine={end_line}",
        ]
        if line == end_line:
            places += [f"col={column}", f"endColumn={end_column}"]
    text = "\n".join([finding.message, *finding.help])
    return f"::{finding.severity} {','.join(places)}::{workflow_data(text)}"


def sarif(findings: Sequence[Diagnostic]) -> dict[str, Any]:
    """The findings as a SARIF log with one run."""
    codes = sorted({finding.code for finding in findings})
    driver = {
        "name": "stlc",
        "version": __version__,
        "rules": [{"id": code, "shortDescription": {"text": CODES[code]}} for code in codes],
    }
    results = [_result(finding, codes.index(finding.code)) for finding in findings]
    run = {"tool": {"driver": driver}, "columnKind": "unicodeCodePoints", "results": results}
    return {"$schema": _SCHEMA, "version": "2.1.0", "runs": [run]}


def _result(finding: Diagnostic, rule: int) -> dict[str, Any]:
    text = "\n".join([finding.message, *finding.help, *finding.note])
    result: dict[str, Any] = {
        "ruleId": finding.code,
        "ruleIndex": rule,
        "level": finding.severity,
        "message": {"text": sarif_message(text)},
    }
    if finding.span is not None:
        result["locations"] = [_location(finding.span)]
    related = [
        {**_location(label.span), "message": {"text": sarif_message(label.text)}} for label in finding.labels
    ]
    if related:
        result["relatedLocations"] = related
    return result


def _location(span: Span) -> dict[str, Any]:
    (line, column), (end_line, end_column) = _ends(span)
    region = {"startLine": line, "startColumn": column, "endLine": end_line, "endColumn": end_column}
    artifact = {"uri": uri(span.source.name)}
    return {"physicalLocation": {"artifactLocation": artifact, "region": region}}


def _ends(span: Span) -> tuple[tuple[int, int], tuple[int, int]]:
    return span.source.position(span.start), span.source.position(span.end)
