"""`stlc plot --places`: all paths or one, and what it says where there is no map."""

import json

import numpy as np
import pytest
from helpers.walks import walk

from stlc.cli.framework.app import main
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.source import Source
from stlc.trace import Trace
from stlc.view.plotted import _as_declared
from stlc.view.verdicts import margins_of


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    walk().save("walk.npz")


def test_a_map_of_one_trace(tmp_path, capsys):
    assert main(["plot", "walk.npz", "--places", "--trace", "2", "-o", "map.svg", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["shown"] == [2]
    assert (tmp_path / "map.svg").read_text().startswith("<svg")
    assert main(["plot", "walk.npz", "--places", "--trace", "4"]) == 2
    assert "they go from 0 to 3" in capsys.readouterr().err


TANK = """\
spec tank
signal level [m]
require low: always (level < 2 m -> eventually[0 s, 3 s] level >= 2.5 m)
"""
PLANNED = TANK + "require plan: always[0 s, T] level > 0 m\n"


@pytest.mark.parametrize("value", ["0", "5", "1e17", "1.7e308", "-1e305"])
def test_a_map_of_paths_that_stand_still(value, tmp_path, capsys):
    spec = "signal x [m]\nsignal y [m]\nrequire r: always ([x, y] not in circle([90 m, 9 m], 1 m))\n"
    (tmp_path / "a.stl").write_text(spec)
    (tmp_path / "a.csv").write_text(f"t,x,y\n0,{value},{value}\n1,{value},{value}\n")
    assert main(["plot", "a.csv", "--spec", "a.stl", "--places", "-o", "a.svg"]) == 0, capsys.readouterr().err


def test_no_picture_replaces_the_specification(tmp_path, capsys):
    (tmp_path / "tank.svg").write_text(TANK)
    assert main(["plot", "walk.npz", "--spec", "tank.svg", "-o", "./tank.svg"]) == 2
    assert "is a file that this command reads" in capsys.readouterr().err
    assert (tmp_path / "tank.svg").read_text() == TANK


def test_a_suffix_without_a_picture_names_the_formats(tmp_path, capsys):
    assert main(["plot", "walk.npz", "-o", "walk.mp4"]) == 2
    err = capsys.readouterr().err
    assert "error[U101]: `walk.mp4` is no picture" in err
    assert ".svg .png .pdf" in err
    assert not (tmp_path / "walk.mp4").exists()


def test_what_is_violated_is_never_an_empty_panel(tmp_path, capsys):
    (tmp_path / "tank.stl").write_text(TANK)
    (tmp_path / "tank.csv").write_text("t,level\n" + "".join(f"{k},{1.5 + 0.1 * k}\n" for k in range(6)))
    trace = Trace.load(tmp_path / "tank.csv")
    monitor = Monitor(PLANNED, dt=1, horizon=2)
    verdict = monitor.check(trace)
    assert verdict["low"].status == ["violated"]
    found = margins_of(verdict)
    demanded = [[-0.5, -0.4, -0.3, *[np.nan] * 3]]  # at each sample whose window is whole
    np.testing.assert_allclose(found["low"], demanded, atol=1e-9)
    np.testing.assert_allclose(found["plan"], [[1.5, 1.6, 1.7, 1.8, np.nan, np.nan]])
    assert main(["plot", "tank.csv", "--spec", "tank.stl", "--require", "low", "-o", "tank.svg"]) == 0
    assert main(["plot", "tank.csv", "--spec", "tank.stl", "--require", "high"]) == 2
    assert "there is no requirement `high`" in capsys.readouterr().err


def test_a_file_without_units_is_labelled_with_those_of_the_specification(tmp_path):
    (tmp_path / "tank.csv").write_text("t,level\n0,1\n1,2\n2,3\n")
    trace = Trace.load(tmp_path / "tank.csv")
    told = _as_declared(trace, Spec.parse(Source("tank.stl", TANK)))
    assert (trace.signature["level"].unit.text, told.signature["level"].unit.text) == ("", "m")


def test_a_specification_without_places_has_no_map(tmp_path, capsys):
    (tmp_path / "slow.stl").write_text("spec slow\nsignal v [m/s]\nrequire slow: always v < 2 m/s\n")
    assert main(["plot", "walk.npz", "--places", "--spec", "slow.stl"]) == 2
    assert "no requirement of `slow` names a place" in capsys.readouterr().err
    assert main(["plot", "walk.npz", "--places", "--require", "slow", "-o", "map.svg"]) == 2
