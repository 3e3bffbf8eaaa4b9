"""Verdicts as Python shows them, and as they are sent to other processes."""

from __future__ import annotations

import pickle
import sys

import numpy as np
import pytest

import stlc
from stlc.diagnostics import UsageError
from stlc.jsontext import plain
from stlc.signature import Column, Signature

TEXT = "spec tank\nsignal level [m]\nrequire low: always level < 3 m\nrequire `a<b>`: always level > 0 m\n"
BATCH = {"level": np.array([[1.0, 2.0, 4.0], [1.0, 2.0, 2.5]])}


@pytest.fixture
def verdict() -> stlc.Verdict:
    return stlc.Monitor(TEXT, dt=1.0).check({"level": [1.0, 2.0, 4.0]})


def test_one_line_says_the_worst(verdict):
    assert repr(verdict) == "Verdict(violated: 1 of 2 · low -1 m at t = 2 s)"
    assert repr(verdict["low"]) == "RequirementVerdict(low: violated · -1 m at t = 2 s)"
    assert repr(verdict["low"].cause) == "Cause(low: `level < 3 m` is false where level = 4 m, at t = 2 s)"
    several = stlc.Monitor(TEXT, dt=1.0).check(BATCH)
    assert repr(several) == "Verdict(violated: 1 of 2 on 2 traces · low -1 m at trace 0, t = 2 s)"
    assert repr(stlc.explain(stlc.Monitor(TEXT, dt=1.0).check({"level": [1.0, 2.5]}))) == (
        "Explanation(nothing is violated (satisfied); low comes closest: 0.5 m)"
    )
    open_ = stlc.Monitor("signal x\nrequire r: always[0 s, 9 s] x < 3", dt=1.0).check({"x": [1.0]})
    assert repr(open_) == "Verdict(inconclusive: 1 of 1 · r [-inf, 2])"


def test_a_notebook_shows_a_table_whose_texts_are_escaped(verdict):
    shown = verdict._repr_html_()
    assert "<a<b>" not in shown
    assert "a&lt;b&gt;" in shown
    assert shown.count('style="color') == 1
    assert "level &lt; 3 m` is false where level = 4 m" in shown


def test_a_verdict_draws_itself_and_other_results_have_no_picture(verdict):
    pytest.importorskip("matplotlib")
    assert [axes.get_ylabel() for axes in verdict.plot().axes] == [
        axes.get_ylabel() for axes in stlc.plot(verdict).axes
    ]
    with pytest.raises(UsageError, match="a `Trace` has no picture\n  help: a Verdict has one"):
        stlc.plot(stlc.Trace(Signature((Column("x"),)), 1.0, {"x": np.ones((1, 3))}))


def test_a_frame_has_a_row_for_each_requirement_and_trace():
    pytest.importorskip("pandas")
    frame = stlc.Monitor(TEXT, dt=1.0).check(BATCH).to_frame()
    assert frame["verdict"].tolist() == ["violated", "satisfied", "satisfied", "satisfied"]
    assert frame["robustness"].tolist() == [-1.0, 0.5, 1.0, 1.0]


def test_a_robustness_of_several_units_or_of_truth_values_has_no_unit_in_a_frame():
    pytest.importorskip("pandas")
    text = "signal x [m]\nsignal k [K]\nsignal on : bool\nsignal s [1]\n" + "".join(
        f"require r{i}: {rule}\n" for i, rule in enumerate(("x < 3 m", "x < 3 m and k < 9 K", "on", "s < 2"))
    )
    frame = stlc.check(text, {"t": [0, 1], "x": [1, 1], "k": [2, 2], "on": [1, 1], "s": [1, 1]}).to_frame()
    assert frame["unit"].fillna("none").tolist() == ["m", "none", "none", "1"]


def test_polars_is_used_where_pandas_is_missing(verdict, monkeypatch):
    polars = pytest.importorskip("polars")
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert isinstance(verdict.to_frame(), polars.DataFrame)
    told = stlc.check("signal x\nrequire low: x < 3", polars.DataFrame({"t": [0.0, 0.1], "x": [1.0, 4.0]}))
    assert told.satisfied


def test_without_a_package_for_frames_the_error_names_one(verdict, monkeypatch):
    for name in ("pandas", "polars"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(stlc.StlcError, match="R301"):
        verdict.to_frame()


def test_a_told_verdict_says_the_same_without_the_signals(verdict):
    told = pickle.loads(pickle.dumps(verdict.told()))
    assert told.judged_on is None
    assert plain(told) == plain(verdict.told())
    assert repr(told) == repr(verdict)
    assert told._repr_html_() == verdict._repr_html_()
    assert (told.share, told.robustness, told.facts) == (verdict.share, verdict.robustness, verdict.facts)


@pytest.mark.parametrize("at", ["all", 1, None])
def test_what_was_counted_stays(verdict, at):
    found = stlc.Monitor("signal level [m]\nrequire low: always[0 s, 1 s] level < 3 m", dt=1.0).check(
        BATCH, at=at
    )
    told = found.told()
    for one, other in zip(found, told, strict=True):
        assert one.worst == other.worst
        assert (one.instants, one.share, one.statuses) == (other.instants, other.share, other.statuses)
        assert one.figures == other.figures
    assert verdict.told().told().facts == verdict.facts
