"""Repair of rejected plans: every way on the same states, and the table of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.tables.schema import document_schema
from stlc.cli.framework.app import main

SYSTEM = """\
stlc: 1
name: cart
time: {dt: 0.5 s, horizon: 8 steps}
state: {p: {unit: m, range: [-4, 4]}, w: {unit: m/s, range: [-2, 2]}}
control: {u: {unit: m/s^2, range: [-2, 2]}}
flow: {p: w, w: u}
init: {mixture: [{draw: {p: "uniform(-2, 2)", w: "uniform(-1, 1)"}}]}
backup: {bins: 3, T0: [1], batch: 256}
test: {steps: 12, agents: 5}
"""
SPEC = """\
spec cart
system "cart.yaml"
signal p, w
@safety
require clear: always[0, T] p <= 2.5
require near: eventually[0 s, 3 s] always[0 s, 1 s] abs(p - 1) < 0.3
"""


@pytest.mark.apart
def test_ways_are_counted_and_the_page_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cart.yaml").write_text(SYSTEM)
    (tmp_path / "cart.stl").write_text(SPEC)
    assert (
        main(["train", "cart.stl", "--steps", "3", "--held-out", "20", "--no-pictures", "--name", "a"]) == 0
    )
    capsys.readouterr()
    page = tmp_path / "page.md"
    page.write_text("# Page\n")
    command = ["repair", "--samples", "6", "--seeds", "3", "--page", str(page), "--json"]
    assert measure(command) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    rows = {row["way"]: row for row in document["result"]["rows"]}
    assert list(rows) == [
        *("gradient steps", "local search", "long local search", "steps, then search", "full guard")
    ]
    assert len({(row["states"], row["solvable"], row["savable"]) for row in rows.values()}) == 1
    assert all(row["mended"] <= row["solvable"] <= row["states"] for row in rows.values())
    assert all(row["saved"] <= row["savable"] <= row["states"] for row in rows.values())
    assert all(row["times"]["samples"] == row["states"] for row in rows.values())
    assert rows["steps, then search"]["mended"] >= rows["gradient steps"]["mended"] > 0
    text = page.read_text()
    assert "<!-- repair -->" in text
    assert text.count("| cart | ") == 5
