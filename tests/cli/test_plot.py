"""`stlc plot --places`: all paths or one, and what it says where there is no map."""

import json

import pytest
from walks import walk

from stlc.cli.app import main
from stlc.trace import save_trace


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_trace("walk.npz", walk())


def test_a_map_of_one_trace(tmp_path, capsys):
    assert main(["plot", "walk.npz", "--places", "--trace", "2", "-o", "map.svg", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["shown"] == [2]
    assert (tmp_path / "map.svg").read_text().startswith("<svg")
    assert main(["plot", "walk.npz", "--places", "--trace", "4"]) == 2
    assert "they go from 0 to 3" in capsys.readouterr().err


def test_a_specification_without_places_has_no_map(tmp_path, capsys):
    (tmp_path / "slow.stl").write_text("spec slow\nsignal v [m/s]\nrequire slow: always v < 2 m/s\n")
    assert main(["plot", "walk.npz", "--places", "--spec", "slow.stl"]) == 2
    assert "no requirement of `slow` names a place" in capsys.readouterr().err
    assert main(["plot", "walk.npz", "--places", "--require", "slow", "-o", "map.svg"]) == 2
