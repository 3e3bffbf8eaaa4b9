"""Decisions that are timed: where, whose, and the table of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.deployments import picked
from benchmarks.tables.schema import document_schema
from benchmarks.timing import Times
from stlc.cli.framework.app import main
from stlc.controller.deployment.simulator import DeploymentRecording
from stlc.registry import GUARDS

ROOT = Path(__file__).resolve().parent.parent.parent


def recording(acted: list[tuple[int, int]]) -> DeploymentRecording:
    rows, steps = 4, 50
    source = np.zeros((rows, steps), dtype=np.int64)
    for place in acted:
        source[place] = 1
    zero = np.zeros((rows, steps))
    return DeploymentRecording(
        4, np.zeros((rows, steps + 1, 1)), zero[..., None], source, source, zero, zero, zero > 0, (), {}, {}
    )


def test_half_of_the_states_are_those_in_which_a_guard_acted() -> None:
    even, there = picked(recording([(0, 3), (2, 7), (3, 49)]), 20)
    assert len(even) == 10
    assert even[0].tolist() == [0, 0]
    assert even[-1].tolist() == [3, 49]
    assert there.tolist() == [[0, 3], [2, 7], [3, 49]]
    assert len(picked(recording([]), 20)[1]) == 0


def test_times_are_milliseconds() -> None:
    found = Times.of([0.001] * 98 + [0.1, 0.1])
    assert found is not None
    assert found.median == pytest.approx(1.0)
    assert found.p99 > 50.0
    assert Times.of([]) is None


@pytest.mark.apart
def test_guards_are_timed_and_the_page_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    spec = str(ROOT / "specs/traffic.stl")
    small = ["--steps", "3", "--held-out", "20", "--drives", "0", "--set", "test.steps=20"]
    assert main(["train", spec, *small, "--no-pictures", "--name", "a"]) == 0
    capsys.readouterr()
    page = tmp_path / "page.md"
    page.write_text("# Page\n")
    command = ["latency", "--samples", "4", "--seeds", "3", "--page", str(page), "--json"]
    assert measure(command) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, document_schema()) == []
    rows = document["result"]["rows"]
    assert [row["guard"] for row in rows] == ["policy", *GUARDS]
    assert rows[0]["acting"] is None
    assert all(row["every"]["samples"] == 2 for row in rows)
    assert all(0 < row["every"]["median"] <= row["every"]["p99"] for row in rows)
    assert any(row["acting"] and row["acting"]["samples"] > 0 for row in rows)
    text = page.read_text()
    assert "<!-- latency -->" in text
    assert text.count("| traffic | ") == 1 + len(GUARDS)
