"""Verdicts as a table in a file: a row for each file and requirement."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from stlc.cli.commands.check.many import Outcome
from stlc.diagnostics import usage
from stlc.escape import encodable, spreadsheet
from stlc.files import File

COLUMNS = {
    "file": "string",
    "requirement": "string",
    "verdict": "string",
    "robustness": "float64",
    "unit": "string",
    "violated_at": "float64",
    "samples": "int64",
    "error": "string",
}
"""Columns of the table, with their types in Arrow's words."""
SUFFIXES = (".parquet", ".csv")


def require_table(path: Path) -> None:
    """Check the value of `--table` before anything is judged.

    Raises:
        UsageError: U101, the suffix is unknown, or the path is a folder.
        MissingError: R301, the package that writes the file is not installed.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise usage(f"`--table {path}` is not a table that stlc writes", "name it .parquet or .csv")
    if path.is_dir():
        raise usage(f"`--table {path}` is a folder")
    if path.suffix.lower() == ".parquet":
        from stlc.trace.formats.registry import format_of

        format_of(path).require()


def write_table(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write the results of files to a table, atomically.

    Raises:
        MissingError: R201, the disk is full, or the user may not write there.
    """
    rows = [
        tuple(encodable(value) if isinstance(value, str) else value for value in row)
        for outcome in outcomes
        for row in _rows(outcome)
    ]
    if path.suffix.lower() == ".parquet":
        from stlc.trace.formats.parquet import write_columns

        values = zip(*rows, strict=True) if rows else [()] * len(COLUMNS)
        columns = zip(COLUMNS.items(), values, strict=True)
        write_columns(path, {name: (kind, list(each)) for (name, kind), each in columns})
        return
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:  # no spreadsheet program runs their texts
        writer.writerow([spreadsheet(each) if isinstance(each, str) else each for each in row])
    File(path).write(text.getvalue())


def _rows(outcome: Outcome) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a file, in the order of `COLUMNS`; one row if it could not be judged."""
    if outcome.errors:
        error = "; ".join(f"{each.code}: {'; '.join([each.message, *each.note])}" for each in outcome.errors)
        yield (outcome.name, None, outcome.word, None, None, None, None, error)
    for row in outcome.rows:
        status = "out of scope" if outcome.status == "out of scope" else row.overall
        figures = row.figures
        least = None if row.overall == "inconclusive" else figures.min
        samples = None if outcome.verdict is None else outcome.verdict.about.samples
        yield (outcome.name, row.name, status, least, figures.unit or None, row.violated_at, samples, None)
