"""`stlc simulate SPEC --plant FILE`: points, verdicts, findings, exit codes, records."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from helpers.documents import misfits

from stlc.assurance import plant_judge as module
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.trace import Trace

CODE = """
import os


class Tank:
    def __init__(self, dt):
        self.dt = dt

    def reset(self, initial, params):
        self.level, self.leak = initial["level"], params["leak"]
        return [self.level]

    def step(self, inputs):
        self.level += self.dt * (inputs["inflow"] - self.leak * self.level)
        if self.level > 1.9:
            print("overflow", flush=True)
            os._exit(1)
        return [self.level]
"""
PLANT = """\
plant: 1
name: tank
python: "tank.py:Tank"
time: {dt: 0.1 s, duration: 2 s}
initial: {level: {unit: m, range: [0, 1.8]}}
param: {leak: {unit: Hz, range: [0.5, 1]}}
input: {inflow: {unit: m/s, range: [0, 1], pieces: 2}}
output: {level: {unit: m}}
"""
SPEC = """\
spec filling
signal level: real [m]
require enough: eventually[0 s, 2 s] level >= 20 cm
require calm: always[0 s, 2 s] level <= 1.5 m
"""
GOOD = ["--from", "level=50 cm, leak=0.5, inflow=0.2"]
HIGH = ["--from", "level=1.6 m, leak=0.5, inflow=0"]
LOST = ["--from", "level=1.8 m, leak=0.5, inflow=1"]


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tank.py").write_text(CODE)
    (tmp_path / "tank.yaml").write_text(PLANT)
    (tmp_path / "filling.stl").write_text(SPEC)
    return tmp_path


def simulate(*options: str) -> int:
    return main(["simulate", "filling.stl", "--plant", "tank.yaml", *options])


@pytest.mark.parametrize(
    ("options", "code", "verdict"), [(GOOD, 0, "satisfied"), (HIGH, 0, "violated"), (LOST, 1, "finding")]
)
def test_a_point_is_judged(options, code, verdict, capsys):
    assert simulate(*options, "--json") == code
    document = json.loads(capsys.readouterr().out)
    assert not misfits(document, load_schema("simulate/1"))
    assert document["exit_code"] == code
    (run,) = document["result"]["runs"]
    assert run["verdict"] == verdict
    assert (run["finding"] is not None) == (verdict == "finding")
    if verdict == "violated":
        calm = next(each for each in run["requirements"] if each["name"] == "calm")
        assert calm["robustness"] == pytest.approx(-0.1)
        assert (calm["unit"], calm["verdict"]) == ("m", "violated")


def test_the_text_says_what_happened(capsys):
    assert simulate(*LOST) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "filling on tank    1 simulation of 2 s, dt 0.1 s"
    point = "level=1.8 m, leak=0.5 Hz, inflow_values[0]=1 m/s, inflow_values[1]=1 m/s"
    assert lines[3].split() == ["0", "FINDING", "crash", *point.split()]
    assert "seed 0: crash: the process of the plant ended with exit code 1" in lines
    assert "  | overflow" in lines
    assert lines[-1] == "0 of 1 simulations satisfy every requirement; 1 without a trace"


def test_points_are_drawn_by_seed_and_recorded(capsys):
    assert simulate("--seeds", "0..3", "--from", "level=0.4 m", "--record", "trace.npz", "--jobs", "2") == 0
    text = capsys.readouterr().out
    assert "4 of 4 simulations satisfy every requirement" in text
    trace = Trace.load("trace.npz")
    assert (trace.traces, trace.samples) == (4, 21)
    assert (trace.data["level"][:, 0] == 0.4).all()
    assert len(np.unique(trace.data["leak"][:, 0])) == 4
    assert main(["check", "trace.npz"]) == 0
    assert "4 of 4 traces satisfy every requirement" in capsys.readouterr().out


CENTIMETRES = """\
spec drier
signal level: real [cm]
signal inflow: real [mm/s]
param leak: real [Hz] in [0, 5]
const most = 150 cm
require calm: always[0 s, 2 s] level <= most
require small: always[0 s, 2 s] inflow <= 500 mm/s
require tight: leak <= 0.9 Hz
"""


def test_recorded_traces_are_checked_and_plotted(home, capsys):
    """Traces of a plant carry specification, constants and units, and are judged as the plant was."""
    (home / "drier.stl").write_text(CENTIMETRES)
    options = ["--plant", "tank.yaml", "--seeds", "0..5", "--set", "most=1.2 m", "--record", "trace.npz"]
    code = main(["simulate", "drier.stl", *options, "--json"])
    runs = json.loads(capsys.readouterr().out)["result"]["runs"]
    found = [run for run in runs if run["verdict"] != "finding"]
    assert code == int(len(found) < len(runs))
    assert len(found) > 0
    assert main(["check", "trace.npz", "--json"]) == 1
    checked = json.loads(capsys.readouterr().out)["result"]
    assert (checked["traces"], checked["verdict"]) == (len(found), "violated")
    assert checked["satisfied_traces"] == [run["verdict"] for run in found].count("satisfied")
    trace = Trace.load("trace.npz")
    assert trace.meta.spec_set == {"most": "1.2 m"}
    assert [column.unit.text for column in trace.signature.columns] == ["m", "m/s", "Hz"]
    for row, run in enumerate(found):
        calm = next(each for each in run["requirements"] if each["name"] == "calm")
        wanted = 100 * (1.2 - trace.data["level"][row].max())
        assert (calm["robustness"], calm["unit"]) == (pytest.approx(wanted), "cm")
    assert main(["check", "drier.stl", "trace.npz", "--certify", ".5", "--json"]) in (0, 1, 4)
    assert json.loads(capsys.readouterr().out)["result"]["assurance"]["overall"]["units"] == len(found)
    assert main(["plot", "trace.npz", "--out", "levels.svg"]) == 0
    assert "level" in (home / "levels.svg").read_text()
    assert main(["simulate", "drier.stl", *options[:-1], "trace.csv"]) == code
    (following,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("next: ")]
    assert main(shlex.split(following)[2:]) == 1
    assert "drier.stl on trace.csv" in capsys.readouterr().out
    (home / "wrong.stl").write_text(CENTIMETRES.replace("real [cm]", "real [s]").replace("150 cm", "150 s"))
    assert main(["check", "wrong.stl", "trace.npz"]) == 3


def test_a_stream_has_the_same_verdicts(monkeypatch, capsys):
    found = []
    for limit in (10**6, 20):  # steps from which simulations are judged while they run
        monkeypatch.setattr(module, "STREAMED", limit)
        assert simulate("--seeds", "0..4", "--json") == 0  # it measures
        found.append(json.loads(capsys.readouterr().out)["result"])
    assert [each.pop("streamed") for each in found] == [False, True]
    assert found[0] == found[1]
    assert {run["verdict"] for run in found[0]["runs"]} == {"satisfied", "violated"}


def test_a_share_may_be_wanted(capsys):
    assert simulate("--seeds", "0..4", "--json") == 0
    result = json.loads(capsys.readouterr().out)["result"]
    share = result["satisfied"] / len(result["runs"])
    assert 0.0 < share < 1.0
    assert simulate("--seeds", "0..4", "--fail-under", f"{share}") == 0
    assert simulate("--seeds", "0..4", "--fail-under", f"{share + 0.01}") == 1


def test_a_short_simulation_is_inconclusive_and_no_evidence(home, capsys):
    (home / "filling.stl").write_text(SPEC.replace("[0 s, 2 s] level >=", "[0 s, 3 s] level >="))
    assert simulate("--from", "level=0, leak=1, inflow=0") == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("satisfy every requirement; 1 inconclusive")
    assert simulate("--from", "level=0, leak=1, inflow=0", "--fail-under", "0.1") == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--from", "levle=1"], "did you mean `level`"),
        (["--from", "level=3"], "outside the range"),
        (["--from", "level=1 s"], "is in [m]"),
        (["--from", "level=1 furlong"], "unknown unit"),
        (["--from", "level"], "NAME=NUMBER"),
        (["--from", "level=high"], "NAME=NUMBER"),
        (["--guard", "full"], "`--guard` is for trained policies"),
        (["--stream", "--record", "a.npz"], "needs whole traces"),
        (["--record", "a.txt"], "a trace is written as"),
        (["--plant", "tonk.yaml"], "did you mean `tank.yaml`"),
    ],
)
def test_a_wrong_option_is_an_error_before_anything_runs(options, said, home, capsys):
    (home / "tank.py").write_text("raise SystemExit")
    assert simulate(*options) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--stream"], ["--from", "x=1"]])
def test_options_of_plants_need_a_plant(options, capsys):
    assert main(["simulate", "latest", *options]) == 2
    assert "is for plants" in capsys.readouterr().err


def test_files_that_do_not_fit_are_an_error_with_a_place(home, capsys):
    (home / "tank.py").write_text("raise SystemExit")
    (home / "filling.stl").write_text(SPEC.replace("level", "height"))
    assert simulate() == 3
    assert "error[E601]: trace `tank` has no signal `height`" in capsys.readouterr().err
    (home / "filling.stl").write_text(
        SPEC.replace("[m]", "[s]").replace("20 cm", "1 s").replace("1.5 m", "1 s")
    )
    assert simulate() == 3
    assert "error[E605]" in capsys.readouterr().err
    (home / "filling.stl").write_text(SPEC)
    (home / "tank.yaml").write_text(PLANT.replace("range: [0, 1.8]", "range: [2, 1]"))
    assert simulate() == 3
    error = capsys.readouterr().err
    assert "error[S204]: the range of `initial.level` ends before it starts" in error
    assert "tank.yaml:5" in error
