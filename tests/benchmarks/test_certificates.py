"""The table of certificates: coverage of the bounds on stored drives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.tables.certificates import coverage
from benchmarks.tables.schema import document_schema
from stlc.cli.framework.app import main


def test_coverage_is_that_of_the_stored_drives() -> None:
    rng = np.random.default_rng(0)
    rho = rng.normal(size=400)
    stored = {
        "key": {"spec": "any", "steps": 9},
        "good": (rho > -1.5).astype(int),
        "rho": rho,
        "shifted": rho - 4,
    }
    row = coverage(stored, 200, 100)
    assert (row.drives, row.satisfied) == (400, int((rho > -1.5).sum()))
    assert min(row.exact, row.betting, row.next_drive, row.shifted) >= 0.95
    assert row.unaware < row.shifted
    assert (row.needed, row.needed_any_time) == (299, 418)


def test_drives_are_stored_and_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "-q"]) == 0
    train = "train specs/cart.stl --steps 1 --batch 16 --held-out 10 --drives 0 --no-pictures -q"
    assert main(train.split()) == 0
    command = (
        "certificates latest --drives 20 --steps 3 --recalibrations 5 --out results --page page.md --json"
    )
    tables = []
    for driving in (True, False):
        capsys.readouterr()
        assert measure(command.split()) == 0
        out, err = capsys.readouterr()
        assert ("driving cart" in err) is driving
        document = json.loads(out)
        assert misfits(document, document_schema()) == []
        tables.append(document["result"]["rows"])
    assert tables[0] == tables[1]
    assert "| cart | 20 x 3 |" in Path("page.md").read_text()
