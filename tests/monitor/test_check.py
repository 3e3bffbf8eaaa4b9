"""`stlc.check`: what its options are for."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stlc
from stlc.diagnostics import TraceError, UsageError
from stlc.monitor.check import OF_TABLES, Question
from stlc.signature import Column, Signature

SPEC = "spec s\nsignal x\nrequire a: always x > 0\n"
UNEVEN = {"t": [0.0, 1.0, 2.0, 3.2], "x": [1.0, 2.0, 3.0, -4.0]}


@pytest.mark.parametrize("name", sorted(OF_TABLES))
def test_an_option_of_tables_is_refused_for_a_trace_that_has_been_read(name: str) -> None:
    trace = stlc.Trace(Signature((Column("x"),)), 1.0, {"x": np.ones((1, 3))})
    assert stlc.check(SPEC, trace).statuses == ["satisfied"]
    with pytest.raises(UsageError, match=f"`{name}` says how a table is read"):
        stlc.check(SPEC, trace, **{name: getattr(Question(), name)})


@pytest.mark.parametrize("package", ["", "pandas", "polars"])
def test_times_that_are_not_uniform_are_resampled_as_the_error_says(package: str) -> None:
    given: Any = pytest.importorskip(package).DataFrame(UNEVEN) if package else UNEVEN
    with pytest.raises(TraceError, match=r"E602[^\n]*\n  help: resample=0\.5  puts them") as raised:
        stlc.check(SPEC, given)
    assert "--" not in str(raised.value)
    assert "resample=0.5" in str(pickle.loads(pickle.dumps(raised.value)))
    assert stlc.check(SPEC, given, resample=0.5).status == "violated"


def test_columns_have_the_names_that_are_given() -> None:
    given = {"clock": [0.0, 1.0], "speed": [1.0, -1.0]}
    assert stlc.check(SPEC, given, names={"x": "speed"}).status == "violated"
    with pytest.raises(TraceError, match=r'help: .*names=\{"t": "NAME"\}'):
        stlc.check(SPEC, {"x": [1.0, 2.0], "y": [1.0, 2.0]}, group="", dt=None)


@pytest.mark.parametrize("name", ["t", "time", "timestamp"])
def test_the_index_of_a_frame_is_its_clock_if_it_is_called_so(name: str) -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({name: [0.0, 0.5], "x": [1.0, -1.0]})
    for given in (frame, frame.set_index(name)):
        assert stlc.check(SPEC, given).about.dt == 0.5
    with pytest.raises(TraceError, match="E601"):
        stlc.check(SPEC, frame.set_index(name).rename_axis("place"))


def test_arguments_in_the_other_order_are_told_so() -> None:
    pandas = pytest.importorskip("pandas")
    spec, given = stlc.parse(SPEC), {"t": [0.0, 1.0], "x": [1.0, 2.0]}
    for recording in (given, pandas.DataFrame(given), "drive.csv"):
        with pytest.raises(UsageError, match=r"comes first.*\n  help: stlc\.check\(spec, trace\)"):
            stlc.check(recording, spec)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"stlc\.check\(spec, trace\)"):
        stlc.check("drive.csv", "drive.stl")
    for odd in ([1.0, 2.0], None):
        with pytest.raises(UsageError, match="or arrays by name"):
            stlc.check(SPEC, odd)  # type: ignore[arg-type]


def test_a_file_that_is_not_there_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"U102.*`driv\.csv`"):
        stlc.check(SPEC, "driv.csv")
