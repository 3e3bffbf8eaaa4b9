"""The overhead of intervals: every row is measured, and it stays small."""

from __future__ import annotations

import json
import sys
from statistics import median

import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.formulas import CASES
from benchmarks.store import BENCHMARKS
from benchmarks.tables.schema import document_schema
from benchmarks.tables.uncertain import overheads


@pytest.mark.apart
def test_all_formulas_and_specifications_are_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert measure(["uncertain", "--samples", "300", "--traces", "10", "--seconds", "0", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    assert len(document["result"]["rows"]) == len(CASES) + len(BENCHMARKS)


@pytest.mark.bench
def test_intervals_take_a_few_times_as_long(capsys: pytest.CaptureFixture[str]) -> None:
    rows = overheads(seconds=1.0).rows
    with capsys.disabled():
        for row in rows:
            sys.stdout.write(f"\n{row.subject}: {row.ratio:.1f}x of {row.time}")
    assert median(row.ratio for row in rows) <= 4.0
