"""`stlc lint`: errors and warnings in specifications."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import quote

import typer

from stlc.cli.framework.options import JsonOption, SpecsArgument
from stlc.cli.framework.output import Answer, Document, emit, say, wants_color
from stlc.cli.framework.program import command
from stlc.diagnostics import CODES, Diagnostic, usage
from stlc.escape import visible
from stlc.files import File
from stlc.options import Options
from stlc.source import Span
from stlc.version import __version__

if TYPE_CHECKING:
    from stlc.monitor.linted import Lint

Format = Literal["text", "json", "github", "sarif"]

CLEAN, FOUND, INVALID = 0, 1, 3


@command(
    "stlc lint specs/traffic.stl",
    "stlc lint specs --strict --format github",
    "stlc lint specs/traffic.stl --system car.yaml --fix",
    "stlc lint specs/traffic.stl --trace drive.csv",
)
def lint(
    files: SpecsArgument = None,
    fix: Annotated[
        bool, typer.Option("--fix", help="Repair in place, without changing what is required.")
    ] = False,
    select: Annotated[
        str | None,
        typer.Option(metavar="CODES", help="Warnings to look for, such as W1,W304; ALL for every one."),
    ] = None,
    ignore: Annotated[str | None, typer.Option(metavar="CODES", help="Warnings to leave out.")] = None,
    format_: Annotated[Format, typer.Option("--format", help="How findings are written.")] = "text",
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 if there are warnings.")] = False,
    system: Options.System = None,
    trace: Annotated[
        Path | None,
        typer.Option("--trace", metavar="FILE", help="Also tell what this recording does not test."),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="Look again whenever a file changes.")] = False,
    json: JsonOption = False,
) -> Answer[Lint]:
    """Report errors and warnings in specifications.

    Checks syntax, types, units, parentheses, unused names, and requirements that require little. With a
    system, that of --system or else the one that the file names, it also checks that the specification fits
    it. Exit code: 0 no errors, 1 warnings and --strict, 3 errors.
    `stlc explain CODE` says what a code means.
    """
    from stlc.monitor.linted import lint as lint_files

    names = File.specs(files or ["."])
    if watch and File.STDIN in names:
        raise usage("`--watch` needs files, not the standard input")

    def linted() -> Answer[Lint]:
        found = lint_files(
            names, fix=fix, select=_codes(select), ignore=_codes(ignore), system=system, trace=trace
        )
        code = INVALID if found.invalid else FOUND if strict and found.findings else CLEAN
        return Answer(found, lambda: _show(format_, found, code), code, found.findings)

    if not watch:
        return linted()
    from stlc.cli.framework.watch import watch as watch_files

    watch_files(names, lambda: linted().print("lint/1", as_json=json))
    raise typer.Exit


def _codes(text: str | None) -> tuple[str, ...]:
    return tuple(code.strip().upper() for code in (text or "").split(",") if code.strip())


def _show(format_: Format, result: Lint, code: int) -> None:
    """Print the findings in the format of `--format`; a JSON document also contains the exit code `code`."""
    findings = result.findings
    match format_:
        case "json":
            Document("lint/1", code, findings, result).print()
        case "github":
            if findings:
                emit(github(findings))
        case "sarif":
            from stlc.jsontext import dumps

            emit(dumps(sarif(findings), indent=2))
        case "text":
            from stlc.monitor.linted import several

            if findings:
                from stlc.cli.framework.render import render_text

                emit(render_text(findings, color=wants_color(sys.stdout)).rstrip("\n") + "\n", styled=True)
            fixed = f"fixed {several(result.fixed, 'finding')}; " if result.fixed else ""
            repairable = sum(finding.fix is not None and finding.fix.same for finding in findings)
            more = f"; {repairable} can be repaired: stlc lint --fix" if repairable else ""
            say(f"{fixed}{result.brief}{more}")


# ------------------------------------------------------- findings for other programs

_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"


def github(findings: Iterable[Diagnostic]) -> str:
    """Findings as commands of GitHub Actions: a line `::error …`, `::warning …` or `::notice …` each."""
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
    level = "notice" if finding.severity == "fact" else finding.severity
    return f"::{level} {','.join(places)}::{workflow_data(text)}"


def sarif(findings: Sequence[Diagnostic]) -> dict[str, Any]:
    """Findings as a log in the format SARIF, with one run."""
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
        "level": "note" if finding.severity == "fact" else finding.severity,
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


def uri(path: str) -> str:
    """Return a path as a relative URI reference, in which special characters are percent-encoded."""
    return quote(path.replace("\\", "/"), safe="/-._~+@=,()", errors="surrogateescape")


def sarif_message(text: str) -> str:
    """Escape links and placeholders in a plain message of SARIF 2.1.0 (sections 3.11.5 and 3.11.6)."""
    return re.sub(r"\](?=\()", r"\\]", re.sub(r"\{(\d+)\}", r"{{\1}}", text))


def workflow_data(text: str) -> str:
    """Escape the message of a workflow command of GitHub Actions (`::error::message`), in one line."""
    return visible(text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A"))


def workflow_property(text: str) -> str:
    """Escape the value of a property of a workflow command of GitHub Actions, such as its file name."""
    return workflow_data(text).replace(":", "%3A").replace(",", "%2C")
