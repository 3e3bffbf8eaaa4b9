"""Requirements that best plans violate, and planners that do better."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.point import task

from stlc.controller.search.missed import STARTS, Missed, better_planner, missed


def test_the_requirement_that_most_best_plans_violate_comes_first(tmp_path: Path) -> None:
    rules = ("low: always[0, T] x < 6 m", "here: always[0, T] x > 1 m", "far: eventually[0, T] x > 9.5 m")
    found = task(tmp_path, "\n".join(f"require {rule}" for rule in rules))
    x0 = torch.tensor([[4.0], [4.5], [5.0]])
    plans = torch.tensor([0.0, 0.5, 0.5])[:, None, None].expand(3, 8, 1)
    assert missed(found, x0, plans) == (
        Missed("far", 3, pytest.approx(-0.5)),
        Missed("low", 2, pytest.approx(-2.5)),
    )
    assert missed(found, x0[:0], plans[:0]) == ()


def test_a_deadline_that_is_over_is_missed_by_no_number(tmp_path: Path) -> None:
    found = task(tmp_path, "require a: eventually@[0 s, 4 s] ((always[0 s, 2 s] x > 0.8 m) and x < 2 m)")
    x0 = found.sample(1, seed=0)
    x0[:, found.system.names.index("clock")] = 5.0
    assert missed(found, x0, torch.zeros(1, 8, 1)) == (Missed("a", 1, -torch.inf),)


def test_a_planner_that_finds_plans_is_named(tmp_path: Path) -> None:
    found = task(tmp_path, "require far: eventually[0, T] x > 9 m")
    x0 = found.sample(5, seed=0)
    better = better_planner(found, x0, "search", 60.0)
    assert better is not None
    assert (better.method, better.satisfied, better.starts) == ("schedule", STARTS, STARTS)
    assert better_planner(found, x0, "search", 0.1) is None, "too little time for a try"
    assert better_planner(found, x0[:0], "search", 60.0) is None
    impossible = task(tmp_path, "require far: eventually[0, T] x > 14 m")
    assert better_planner(impossible, x0[:1], "search", 2.0) is None
