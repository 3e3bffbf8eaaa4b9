"""The profile of a step: its parts, its figures, its tables and documents."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.steps import speed, step_timing
from benchmarks.store import load
from benchmarks.tables.schema import document_schema


@pytest.mark.apart
def test_the_parts_of_a_step_are_measured_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Page\n")
    command = ["step", "--only", "traffic", "--seconds", "0", "--warm", "2"]
    assert measure([*command, "--json", "--page", str(page)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert misfits(printed, document_schema()) == []
    document = printed["result"]
    (step,), (fast,) = document["steps"], document["speeds"]
    assert all(value > 0 for key, value in step.items() if key not in ("benchmark", "backward", "search"))
    assert fast["reported"] == 59.0
    text = page.read_text()
    assert text.startswith("# Page\n")
    assert text.count("| traffic | ") == 2
    assert "<!-- step -->" in text


@pytest.mark.bench
@pytest.mark.parametrize("name", ["traffic", "reach_n_avoid", "ship_safe", "ship_track", "manipulation"])
def test_rollouts_with_gradients_take_a_fifth_of_the_authors_time(name: str) -> None:
    found = speed(name, load(name), seconds=2.0)
    assert found.native is not None
    assert found.reported is not None
    assert found.native < found.reported / 5
    assert found.native < found.torch


@pytest.mark.bench
def test_six_million_verdicts_a_second_on_traffic() -> None:
    assert speed("traffic", load("traffic"), seconds=3.0).verdicts > 6e6


@pytest.mark.bench
def test_a_step_is_the_sum_of_its_parts() -> None:
    found = step_timing("traffic", load("traffic"), seconds=3.0, warm=60)
    parts = found.forward + found.verdict + found.gradient + found.backward + found.optimiser
    assert 0.7 * found.whole < parts < 1.3 * found.whole
