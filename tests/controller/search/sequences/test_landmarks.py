"""Landmarks on the way to a target."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.text import show_formula
from stlc.controller.problem.task import Task
from stlc.controller.search.sequences.landmarks import Landmarks
from stlc.controller.search.sequences.sequences import Sequences
from stlc.signature import Column

MISSIONS = Path(__file__).parents[3] / "data/sequences"


@pytest.fixture(scope="module")
def lift() -> Sequences:
    task = Task.load(MISSIONS / "lift.stl")
    return Sequences(task, task.sample(1, seed=0)[0].double())


def test_an_open_door_needs_a_floor_first_and_before_that_a_closed_door(lift: Sequences) -> None:
    for target, marks in zip(lift._targets[:3], lift._marks[:3], strict=True):
        assert "door >= 0.9" in show_formula(target)
        closed, there = (show_formula(lift._targets[mark]) for mark in marks)
        assert closed == "door <= 0.05"
        assert "abs(v) <= 0.1" in there
        assert "door" not in there


def test_only_the_floor_that_is_asked_for_is_left(lift: Sequences) -> None:
    places = [show_formula(lift._targets[marks[1]]) for marks in lift._marks[:3]]
    assert len(set(places)) == 3
    assert not any(" or " in place for place in places)


def test_alternatives_are_compared_with_what_is_left_of_the_target_alone() -> None:
    x, y = ir.Signal("x"), ir.Signal("y")
    low, five, one, three = (ir.Predicate(num) for num in (1.0 - x, y - 5.0, 1.0 - y, y - 3.0))
    ranges = {name: Column(name, low=0.0, high=10.0) for name in "xy"}
    marks = Landmarks([(low, five), (low, one, three)], ranges).of(ir.Predicate(x - 8.0))
    assert marks == (low & low, five & (one | three))
