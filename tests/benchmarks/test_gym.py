"""The speed of environments: the table, and the target."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

pytest.importorskip("gymnasium")

from benchmarks.__main__ import main as measure
from benchmarks.episodes import episode_speed
from benchmarks.store import BENCHMARKS, load
from benchmarks.tables.schema import document_schema
from benchmarks.timing import one_thread


def test_the_table_is_measured_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Page\n")
    command = ["gym", "--only", "traffic", "--seconds", "0", "--envs", "2", "--envs", "1024"]
    assert measure([*command, "--json", "--page", str(page)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert misfits(printed, document_schema()) == []
    (row,) = printed["result"]["rows"]
    assert row["environments"] == [2, 1024]
    assert 0 < row["rates"][0] < row["rates"][1]
    assert "| benchmark | 2 | 1,024 |" in page.read_text()


def test_a_reward_that_does_not_exist_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert measure(["gym", "--only", "traffic", "--reward", "dense"]) == 2
    assert "no reward `dense`" in capsys.readouterr().err


@pytest.mark.bench
@pytest.mark.parametrize("reward", ["task", "robustness"])
@pytest.mark.parametrize("name", BENCHMARKS)
def test_half_a_million_steps_a_second(name: str, reward: str) -> None:
    with one_thread():
        found = episode_speed(name, load(name), (512,), reward=reward, seconds=1.0)  # type: ignore[arg-type]
    assert found.rates[0] > 500_000
