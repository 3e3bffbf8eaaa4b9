"""The table of failing drives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

from benchmarks.__main__ import main as measure
from benchmarks.options import Training
from benchmarks.store import ResultStore
from benchmarks.tables.failures import (
    AFTER,
    FALSIFYING,
    FRESH,
    ORDER,
    SeedRow,
    _cells,
    rows_of,
    seed_rows_of,
)
from benchmarks.tables.schema import document_schema
from benchmarks.training import Length, Place, _job
from stlc.cli.framework.app import main

ROOT = Path(__file__).parents[2]


def _result(what: str, trained: str = "guided", failing: int = 1) -> dict[str, object]:
    key = {"benchmark": "traffic", "guard": "none", "trained": trained, "simulations": 3, "agents": 20}
    key |= {"steps": 9, "random": what != "falsify", "seed": FRESH if what == "fresh" else 0}
    return {"key": key, "least": -0.5, "failing": failing, "drives": 60}


def test_a_row_needs_both_searches_and_fresh_drives() -> None:
    results = [_result("random"), _result("falsify", failing=7), _result("fresh", failing=4)]
    assert rows_of(results[:2]) == []
    (row,) = rows_of(results)
    assert (row.failing_random, row.failing_falsify, row.before, row.after) == (1, 7, 4, None)
    (row,) = rows_of([*results, _result("fresh", AFTER, failing=2)])
    assert row.after == 2


def test_seeds_that_were_trained_both_ways_are_compared() -> None:
    def of_seed(seed: int, trained: str, failing: int, drives: int = 60) -> dict[str, object]:
        result = _result("fresh", trained, failing)
        own = {"training_seed": seed} if seed else {}
        return {**result, "drives": drives, "key": {**result["key"], **own}}  # type: ignore[dict-item]

    results = [of_seed(0, "guided", 3), of_seed(0, AFTER, 6), of_seed(1, "guided", 9)]
    assert seed_rows_of(results) == []
    results += [of_seed(1, AFTER, 12), of_seed(1, AFTER, 1, 6), of_seed(2, "guided", 0), of_seed(3, AFTER, 0)]
    (row,) = seed_rows_of([*results, of_seed(2, "guided:falsify1", 0)])
    assert row == SeedRow("traffic", (0, 1), (0.05, 0.15), (0.1, 0.2))
    searched = [_result("random"), _result("falsify", failing=7), _result("fresh", failing=4)]
    (alone,) = rows_of([*searched, of_seed(1, "guided", 9, 600)])
    assert (alone.fresh, alone.before) == (60, 4)


def test_searches_of_one_size_are_compared() -> None:
    results = [_result("random"), _result("falsify", failing=7), _result("fresh", failing=4)]
    larger = _result("random", failing=50)
    larger["key"] = {**results[0]["key"], "simulations": 100}  # type: ignore[dict-item]
    (row,) = rows_of([*results, larger])
    assert (row.simulations, row.failing_random, row.failing_falsify) == (3, 1, 7)
    other = {**larger, "key": {**larger["key"], "random": False}}  # type: ignore[dict-item]
    (row,) = rows_of([*results, larger, other])
    assert (row.simulations, row.failing_falsify) == (100, 50)
    more = {**_result("fresh", failing=9), "drives": 600}
    (row,) = rows_of([*results, more, _result("fresh", AFTER, failing=2)])
    assert (row.fresh, row.before, row.after) == (600, 9, None)


def test_the_second_training_differs_by_the_option_alone(tmp_path: Path) -> None:
    before, after = _cells("traffic", 3, Length(60.0, clock="processor"), retrain=True, held_out=50)
    place = Place(ResultStore("any", tmp_path), tmp_path)
    first, second = (_job(cell, place, None).arguments for cell in (before, after))
    assert [word for word in second if word not in first] == [
        *(word for word in second if str(place.runs_of(after.key)) == word),
        "--falsify",
    ]
    assert after.options == FALSIFYING
    assert after.contender == AFTER
    assert set(ORDER) == {"traffic", "ship_safe", "manipulation", "navigation", "reach_n_avoid", "ship_track"}


@pytest.mark.slow
def test_drives_of_a_run_fill_a_row_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (cell,) = _cells("ship_safe", 0, Length(steps=1, clock="processor"), retrain=False, held_out=10)
    runs = Training().place("any").runs_of(cell.key)
    words = f"train {ROOT / 'specs/ship_safe.stl'} --method guided --seed 0 --steps 1"
    assert main(
        [
            *words.split(),
            *f"--budget-clock processor --held-out 10 --drives 0 --no-pictures -q --runs {runs}".split(),
        ]
    ) in (
        0,
        1,
    )
    small = "--only ship_safe --simulations 2 --fresh 3 --drive-steps 2 --steps 1 --held-out 10 --no-retrain"
    tables = []
    for driving in (True, False):
        capsys.readouterr()
        assert measure(f"failures {small} --out results --page page.md --json".split()) == 0
        out, err = capsys.readouterr()
        assert ("driving ship_safe-guided-paper-falsify-2" in err) is driving
        document = json.loads(out)
        assert misfits(document, document_schema()) == []
        tables.append(document["result"]["rows"])
    assert tables[0] == tables[1]
    assert "| ship_safe | none | 2 x 1 x 2 |" in Path("page.md").read_text()
