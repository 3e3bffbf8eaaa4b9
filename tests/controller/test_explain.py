"""Explanations as a function: of codes, specifications, verdicts, traces and runs."""

from __future__ import annotations

from pathlib import Path

import pytest

import stlc
from stlc.jsontext import plain

SPEC = "signal x [m]\nrequire low: always x < 3 m\n"


def test_a_code_a_topic_and_all_codes() -> None:
    assert stlc.explain("e203").title.startswith("E203")
    assert stlc.explain("precedence").text
    assert "E203" in stlc.explain().codes
    with pytest.raises(stlc.StlcError, match="there is no code `E999`"):
        stlc.explain("E999")


def test_a_specification_is_told_from_its_tree_and_from_its_file(tmp_path: Path) -> None:
    (tmp_path / "s.stl").write_text(SPEC)
    parsed, read = stlc.explain(stlc.parse(SPEC)), stlc.explain(tmp_path / "s.stl")
    assert parsed.requirements == read.requirements
    assert stlc.explain(stlc.parse(SPEC), require=("low",)) == parsed


def test_a_verdict_and_its_trace_are_explained_alike(tmp_path: Path) -> None:
    (tmp_path / "s.stl").write_text(SPEC)
    (tmp_path / "x.csv").write_text("t,x\n0,1\n0.1,4\n0.2,1\n")
    found = stlc.explain(tmp_path / "x.csv", spec=tmp_path / "s.stl")
    assert repr(found) == "Explanation(low because `x < 3 m` is false where x = 4 m, at t = 0.1 s)"
    assert plain(found) == plain(stlc.explain(found.verdict))
    satisfied = stlc.check(SPEC, {"t": [0.0, 0.1], "x": [1.0, 2.0]})
    closest = "nothing is violated (satisfied); low comes closest: 1 m"
    assert repr(stlc.explain(satisfied)) == f"Explanation({closest})"
