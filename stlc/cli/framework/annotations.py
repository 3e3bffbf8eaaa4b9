"""Diagnostics for other programs: workflow commands of GitHub, and SARIF 2.1.0."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from stlc.diagnostics import CODES, Diagnostic
from stlc.escape import sarif_message, uri, workflow_data, workflow_property
from stlc.source import Span
from stlc.version import __version__

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
