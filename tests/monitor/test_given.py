"""Signals as Python programs give them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stlc.diagnostics import TraceError
from stlc.monitor.verdict import Monitor

LIGHTS = """
enum Light { red, green }
signal light : Light
signal on : bool
require r: always (on -> light == green)
"""


def status(spec: str, given: Any, dt: float | None = None) -> Any:
    return Monitor(spec, dt=dt).check(given).status


def test_times_are_used() -> None:
    spec = "signal x\nrequire r: always (x > 1 -> eventually[0 s, 1 s] x < 0.5)"
    values = np.array([0.0, 2, 2, 2, 0, 0])
    assert status(spec, {"time": np.arange(6.0), "x": values}) == "violated"
    assert status(spec, {"t": 0.1 * np.arange(6), "x": values}) == "satisfied"
    assert (
        status(spec, {"time": np.array(["2026-01-01"] * 6, "M8[s]") + np.arange(6), "x": values})
        == "violated"
    )
    assert status(spec, {"time": [np.arange(6.0)] * 2, "x": [values, values]}).tolist() == ["violated"] * 2
    with pytest.raises(TraceError, match=r"has dt 1 s, the monitor was told 0\.1 s"):
        status(spec, {"time": np.arange(6.0), "x": values}, dt=0.1)
    with pytest.raises(TraceError, match="not uniform"):
        status(spec, {"time": [0, 1, 2, 3, 4, 7.5], "x": values})
    with pytest.raises(TraceError, match="holds words"):
        status(spec, {"time": ["a"] * 6, "x": values})


def test_a_time_that_a_requirement_reads_is_a_signal() -> None:
    assert status("signal t\nrequire r: always t < 9", {"t": [3.0, 1.0, 2.0]}) == "satisfied"


def test_masked_samples_are_unknown() -> None:
    spec = "signal x\nrequire r: always x > 0"
    assert status(spec, {"x": np.ma.array([1.0, -5, 1], mask=[0, 1, 0])}) == "inconclusive"
    assert status(spec, {"x": np.ma.array([1, -5, 1], mask=[0, 0, 1])}) == "violated"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.array([1j, 2j]), "complex"),
        (np.array([{}, {}]), "Python objects"),
        (["a", "b"], "words"),
        (np.array(["2026-01-01"] * 2, "M8[s]"), "dates"),
        (np.zeros(2, dtype="V4"), "V4"),
    ],
)
def test_what_is_no_number_is_refused_by_name(values: Any, words: str) -> None:
    with pytest.raises(TraceError, match=rf"`x` .*{words}"):
        status("signal x\nrequire r: always x > 0", {"x": values})


def test_a_column_is_one_trace() -> None:
    assert status("signal x\nrequire r: eventually x > 3", {"x": np.arange(5.0)[:, None]}) == "satisfied"


def test_words_and_truth_values_are_those_of_files() -> None:
    assert status(LIGHTS, {"light": ["green", "red"], "on": [True, False]}) == "satisfied"
    assert status(LIGHTS, {"light": ["green", "red"], "on": ["yes", "YES"]}) == "violated"
    with pytest.raises(TraceError, match="cannot be `blue`"):
        status(LIGHTS, {"light": ["green", "blue"], "on": [True, False]})


def frames() -> list[Any]:
    columns = {
        "time": [0.0, 0.1, 0.2],
        "light": ["green", "red", None],
        "on": [True, False, False],
        "note": ["", "x", "y"],
    }
    found = []
    for name in ("pandas", "polars"):
        try:
            library = __import__(name)
        except ImportError:
            continue
        found.append(pytest.param(library.DataFrame(columns), id=name))
    return found or [pytest.param(None, marks=pytest.mark.skip("neither is installed"))]


@pytest.mark.parametrize("frame", frames())
def test_data_frames(frame: Any) -> None:
    verdict = Monitor(LIGHTS).check(frame)
    assert verdict.statuses == ["satisfied"]
    assert verdict.subject.dt == pytest.approx(0.1)


def test_what_is_not_read_never_matters() -> None:
    spec = "signal x\nrequire r: always x > 0"
    assert (
        status(spec, {"x": [1.0, 2.0], "meta": {"a": 1}, "odd": [[1], [2, 3]], "z": [1j, 2j, 3j]})
        == "satisfied"
    )
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"x": [1.0, 2.0], "id": [{}, {}], "odd": [[1], [2, 3]]})
    assert Monitor(spec, dt=0.1).check(frame).statuses == ["satisfied"]
    frame["x"] = pandas.array([1, None], dtype="Int64")
    assert Monitor(spec, dt=0.1).check(frame).statuses == ["inconclusive"]
    for ragged in ([[1], [2, 3]], np.array([np.zeros(2), np.zeros(3)], dtype=object)):
        assert status(spec, {"x": [1.0, 2.0], "odd": ragged}) == "satisfied"
        with pytest.raises(TraceError, match="E603"):
            Monitor(spec, dt=0.1).check({"x": ragged})


def test_a_frame_with_an_index_of_times() -> None:
    pandas = pytest.importorskip("pandas")
    index = pandas.date_range("2026-01-01", periods=4, freq="100ms")
    frame = pandas.DataFrame({"x": [1.0, 2, np.nan, 4]}, index=index)
    verdict = Monitor("signal x\nrequire r: always[0 s, 0.3 s] x > 0").check(frame)
    assert verdict.statuses == ["inconclusive"]
