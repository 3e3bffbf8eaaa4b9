"""The table of the parts of the falsification search."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.store import ResultStore
from benchmarks.tables.searches import REMOVALS, WHOLE, Problem, _compared, _name, _searched, problems
from stlc.assurance.model_simulator import ModelSimulator


@pytest.fixture(scope="module")
def every() -> tuple[Problem, ...]:
    return problems()


def test_there_are_thirty_problems_of_our_own_and_rows_of_the_competition(every: tuple[Problem, ...]):
    names = [each.name for each in every]
    assert len(set(names)) == len(names)
    assert [each.competition is None for each in every].count(True) == 30
    assert "AT6a, instance 2" in names


def test_a_search_is_the_same_without_a_part_that_had_no_turn(every: tuple[Problem, ...], tmp_path: Path):
    (problem,) = [each for each in every if each.name == "lander_fast"]
    simulator = ModelSimulator.load(str(problem.spec), None, {})

    def searched(removal: str):
        store = ResultStore("searches", tmp_path)
        return _searched(problem, simulator, removal, (4, 5), store, {})["searches"]

    whole = searched(WHOLE)
    unused = [each for each in REMOVALS[1:-1] if not any(each in search["strategies"] for search in whole)]
    assert len(unused) >= 3
    assert all(searched(removal) == whole for removal in unused)
    without = searched("constant vertices")
    assert all("constant vertices" in each["strategies"] for each in whole)
    assert not any("constant vertices" in each["strategies"] for each in without)


def test_a_ratio_is_that_of_geometric_means_over_the_same_seeds(every: tuple[Problem, ...]):
    def found(*counts: int):
        return {
            "searches": [{"seed": k, "simulations": n, "strategy": "trend"} for k, n in enumerate(counts)]
        }

    removal, (first, second) = REMOVALS[1], every[:2]
    stored = {
        _name(first, WHOLE): found(10, 20, 5),
        _name(first, removal): found(20, 40),
        _name(second, WHOLE): found(30, 8),
        _name(second, removal): found(30, 8),
    }
    row = _compared(removal, stored, every)
    assert row.own == pytest.approx((math.log(2.0), 0.0))
    assert (row.competition, row.missed, row.seeds) == ((), 0, 2)
    assert row.ratios.startswith("1.41 [")
