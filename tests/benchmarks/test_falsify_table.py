"""The table of falsification: searches side by side are those of the command, and its rows."""

from __future__ import annotations

import pytest

from benchmarks.tables.falsify import CASES, _record, _row, side_by_side
from stlc.assurance.falsify import SearchBudget, ViolationSearch, falsify
from stlc.assurance.model_simulator import ModelSimulator
from stlc.files import File


def test_every_case_has_a_name_of_its_own_and_both_instances_are_there():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    assert {"AT1, instance 1", "AT1, instance 2", "F16, instance 1"} <= set(names)
    assert "F16, instance 2" not in names


def test_searches_side_by_side_are_those_of_one_seed_alone():
    (case,) = [each for each in CASES if each.name == "NNx, instance 1"]
    simulator = ModelSimulator.load(str(File.SPECS / "arch" / f"{case.spec}.stl"), None, dict(case.changes))
    searches = [ViolationSearch(simulator, 0, seed) for seed in (1, 2, 3)]
    side_by_side(simulator, searches, case.most)
    together = [_record(search, seed) for search, seed in zip(searches, (1, 2, 3), strict=True)]
    for each in together:
        alone = falsify(simulator, 0, budget=SearchBudget(case.most), seed=each["seed"], shrinks=False)
        assert alone.found is not None
        assert (each["simulations"], each["margin"]) == (alone.simulations, alone.found.margin)
    row = _row(case, {"searches": together})
    assert (row.falsified, row.seeds, row.violated) == (3, 3, 3)
    assert row.mean == pytest.approx(sum(each["simulations"] for each in together) / 3)
    assert row.least is None
    assert "MoonLight" in row.remark
