"""Diagnosis of requirements for which no plan was found, and its proved parts."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.point import task

from stlc.controller.search.conflict import conflict, refuted


@pytest.mark.parametrize(
    ("rule", "proved"),
    [
        ("eventually[0, T] x > 13.1 m", True),  # 5 m and 8 s at 1 m/s
        ("eventually[0, T] x > 12.5 m", False),  # from some of the starts
        ("always[0, T] x > 5 m", True),  # none of them is there
        ("always[2 s, T] x > 5 m", False),
        ("eventually@[0 s, 3 s] x < 0.5 m", True),
        ("eventually@[0 s, 6 s] x < 0.5 m", False),
        ("(x < 9 m) until[0, T] x > 14 m", True),
        ("eventually[0, T] (x > 13.1 m or x < 4 m)", False),
        ("eventually[0, T] (x > 6 m and x < 5 m)", False),  # true, but bounds do not see it
    ],
)
def test_bounds_prove_what_is_out_of_reach(tmp_path: Path, rule: str, proved: bool) -> None:
    assert refuted(task(tmp_path, f"require r: {rule}")) is proved


@pytest.mark.apart
def test_only_what_is_proved_is_said_to_have_no_plan(tmp_path: Path) -> None:
    said = conflict(
        task(tmp_path, "require far: eventually[0, T] x > 14 m\nrequire low: always[0, T] x < 9 m")
    )
    assert said.message == "no plan satisfies `far`"
    assert "proved from each of 64 starts" in said.note[0]
    said = conflict(task(tmp_path, "require never: eventually[0, T] (x > 6 m and x < 5 m)"))
    assert said.message == "no plan was found that satisfies `never`"
    assert "no proof" in said.note[0]
    assert said.note[-1] == "the best plans from 64 starts violate `never` from 64"
