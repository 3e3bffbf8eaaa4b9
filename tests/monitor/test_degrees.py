"""Recorded temperatures: what a file is in against what is declared; limits from the command line."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from stlc.cli.framework.app import main
from stlc.diagnostics import TraceError
from stlc.monitor.online.online import How
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.trace import Trace
from stlc.units import Unit

DEGREES = np.array([20.0, 30.5, 45.0, 59.0, 58.0, 61.0])
RECORDED = {
    "degC": DEGREES,
    "°C": DEGREES,
    "K": DEGREES + 273.15,
    "mK": (DEGREES + 273.15) * 1000,
}
SPEC = """
signal temp [{unit}] in [-40 degC, 120 degC]
const t_max = 60 degC
require hot: always[0 s, 1 s] temp <= t_max
require calm: always[0 s, 0.5 s] abs(temp - 21 degC) <= 45 K
"""


def recorded(unit: str) -> Trace:
    return Trace(Signature((Column("temp", Unit.parse(unit)),)), 0.1, {"temp": RECORDED[unit][None]})


@pytest.fixture(autouse=True)
def _a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def result(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict:
    main(["check", *arguments, "--json"])
    return json.loads(capsys.readouterr().out)["result"]


@pytest.mark.parametrize("unit", RECORDED)
@pytest.mark.parametrize("declared", ["degC", "°C", "K"])
def test_files_and_specifications_of_either_unit(unit: str, declared: str) -> None:
    monitor = Monitor(SPEC.format(unit=declared), dt=0.1)
    found = monitor.check(recorded(unit), end="truncate")
    assert [found[name].robustness for name in ("hot", "calm")] == pytest.approx([-1.0, 5.0], abs=1e-9)
    assert [found[name].unit for name in ("hot", "calm")] == ["K", "K"]


def test_a_file_in_coulombs_is_told_how_degrees_are_written() -> None:
    trace = Trace(Signature((Column("temp", Unit.parse("C")),)), 0.1, {"temp": DEGREES[None]})
    with pytest.raises(TraceError, match="E605") as caught:
        Monitor(SPEC.format(unit="degC"), dt=0.1).check(trace)
    assert "temp [degC]" in caught.value.diagnostics[0].help[0]


@pytest.mark.parametrize("stream", [False, True])
def test_a_file_in_celsius_is_told_how_they_are_written(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, stream: bool
) -> None:
    Path("s.stl").write_text(SPEC.format(unit="degC"), encoding="utf-8")
    text = "t,temp [celsius]\n0,20\n0.1,21\n"
    Path("t.csv").write_text(text, encoding="utf-8")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    assert main(["check", "s.stl", "-" if stream else "t.csv"]) == 3
    assert "are written `degC`" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".mcap"])
def test_units_of_files(suffix: str) -> None:
    for unit in ("degC", "K"):
        name = f"{unit}{suffix}"
        recorded(unit).save(name)
        assert Trace.load(name).signature["temp"].unit == Unit.parse(unit)


@pytest.mark.parametrize(
    ("options", "margin"),
    [
        ((), -1.0),
        (("--set", "t_max=65degC"), 4.0),
        (("--set", "t_max=65"), 4.0),
        (("--set", "t_max=338.15K"), 4.0),
        (("--chunk", "2"), -1.0),
    ],
)
@pytest.mark.parametrize("unit", ["degC", "K"])
def test_limits_from_the_command_line(
    capsys: pytest.CaptureFixture[str], options: tuple[str, ...], margin: float, unit: str
) -> None:
    Path("s.stl").write_text(SPEC.format(unit="degC"), encoding="utf-8")
    recorded(unit).save("t.csv")
    (hot,) = result(capsys, "s.stl", "t.csv", "--require", "hot", "--end", "truncate", *options)[
        "requirements"
    ]
    assert hot["robustness"]["min"] == pytest.approx(margin)
    assert hot["robustness"]["unit"] == "K"
    for reading in hot["cause"]["readings"] if hot["cause"] else ():
        assert reading["text"].startswith("temp = 61 degC")


@pytest.mark.parametrize("limit", ["70degC", "70", "343.15K"])
def test_a_parameter_in_degrees(limit: str) -> None:
    text = "signal temp [K]\nparam limit [degC] in [50 degC, 340 K]\nrequire hot: always temp <= limit"
    monitor = Monitor(text, dt=0.1, overrides={"limit": limit})
    assert monitor.check(recorded("degC"))["hot"].robustness == pytest.approx(9.0)
    (column,) = (c for c in Monitor(text, dt=0.1).compiled.signature.columns if c.name == "limit")
    assert (column.low, column.high) == pytest.approx((50.0, 66.85))


@pytest.mark.parametrize("unit", ["degC", "K"])
def test_a_stream_is_judged_as_a_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, unit: str
) -> None:
    Path("s.stl").write_text(SPEC.format(unit="degC"), encoding="utf-8")
    recorded(unit).save("t.csv")
    of_file = result(capsys, "s.stl", "t.csv")
    text = Path("t.csv").read_text(encoding="utf-8")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    of_stream = result(capsys, "s.stl", "-")
    assert of_stream["requirements"] == of_file["requirements"]


def test_a_monitor_that_is_fed_takes_degrees() -> None:
    online = Monitor(SPEC.format(unit="degC"), dt=0.1).online(How())
    decided = []
    for value in DEGREES:
        online.push({"temp": value})
        found = (each for each in online.verdicts() if each.requirement == "calm")
        decided += [(each.status, online.bounds("calm", each.start)[0]) for each in found]
    assert decided == [("satisfied", 5.0)]


def test_degrees_compile_to_what_their_numbers_do() -> None:
    degrees = Monitor(
        "signal temp [degC]\nrequire r: always[0 s, 1 s] (temp in [18, 24] or abs(temp - 21 degC) <= 0.5 K)",
        dt=0.1,
    )
    numbers = Monitor(
        "signal temp\nrequire r: always[0 s, 1 s] (temp in [18, 24] or abs(temp - 21) <= 0.5)", dt=0.1
    )
    one, other = (monitor.compiled.requirements[0].formula for monitor in (degrees, numbers))
    assert one == other
