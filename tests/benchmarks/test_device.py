"""The comparison of devices: every size on both, its ratio, its page."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.tables import device
from benchmarks.tables.schema import document_schema


@pytest.mark.apart
def test_steps_are_timed_on_both_devices_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "BATCHES", (8, 16))
    monkeypatch.setattr(device, "WIDTHS", (24,))
    page = tmp_path / "page.md"
    command = ["device", "--device", "cpu", "--only", "traffic", "--seconds", "0", "--warm", "1"]
    assert measure([*command, "--json", "--page", str(page)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert misfits(printed, document_schema()) == []
    rows = printed["result"]["rows"]
    assert [(row["network"], row["batch"]) for row in rows] == [
        ("24x24x24", 8),
        ("24x24x24", 16),
    ]
    assert all(row["ratio"] == pytest.approx(row["processor"] / row["device"]) for row in rows)
    assert page.read_text().count("| traffic | ") == 2


def test_a_device_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert measure(["device", "--device", "cuda:77"]) == 5
    assert "there is no device `cuda:77` here" in capsys.readouterr().err
