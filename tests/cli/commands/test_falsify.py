"""`stlc falsify` on a run: counterexamples that can be replayed, baselines, bad input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.documents import misfits

from stlc.assurance.drive_simulator import DriveSimulator
from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.controller.deployment.batched import Setting
from stlc.controller.evaluation.rules import Rules
from stlc.controller.run.run import Run
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir
from stlc.source import Source
from stlc.trace import Trace

SYSTEM = """
stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 8 steps}
state: {x: {unit: m, range: [-4, 4]}, push: {range: [-1, 1], role: env}}
control: {u: {unit: m/s, range: [-0.2, 0.2]}}
flow: {x: "u + push * (1 m/s)"}
init: {mixture: [{draw: {x: "uniform(-0.5, 0.5)", push: 0}}]}
test:
  agents: 2
  steps: 20
  events:
    - {name: gust, every: 0.5 s, set: {push: "uniform(-1, 1)"}}
"""
SPEC = """
system "cart.yaml"
signal x [m]
require near: always[0 s, T] x in [-1.3 m, 1.3 m]
require far: always[0 s, T] x < 30 m
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("cart.yaml").write_text(SYSTEM)
        Path("cart.stl").write_text(SPEC)
        command = ["train", "cart.stl", "--steps", "10", "--batch", "16", "--held-out", "50"]
        assert main([*command, "--no-pictures"]) == 0
    return folder


@pytest.fixture(autouse=True)
def there(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(home)
    capsys.readouterr()


def found(capsys: pytest.CaptureFixture[str], *args: str) -> dict:
    main(["falsify", "latest", "--simulations", "32", *args, "--json"])
    return json.loads(capsys.readouterr().out)["result"]


@pytest.mark.apart
def test_gusts_that_push_the_cart_out_are_found_and_replayed(capsys, tmp_path):
    assert main(["falsify", "latest", "--simulations", "32", "-o", str(tmp_path)]) == 1
    text = capsys.readouterr().out
    assert "near: violated, robustness -" in text
    assert "far: no violation in 32 simulations" in text
    assert "this is no proof" in text
    trace = Trace.load(tmp_path / "near.npz")
    assert np.abs(trace.data["x"]).max() > 1.3
    assert not (tmp_path / "far.json").exists()
    assert main(["falsify", "latest", "--replay", str(tmp_path / "near.json")]) == 1
    assert "the same, bit for bit" in capsys.readouterr().out


@pytest.mark.apart
def test_a_replay_names_the_run_that_was_searched(capsys, tmp_path, monkeypatch):
    """Another run that is made during the search is `latest` afterwards."""
    load = DriveSimulator.__init__

    def loaded(*arguments):
        load(*arguments)
        later = RunDir.create(Path("runs"), "cart", "later")
        shutil.copy("made/run.json", later.path)

    shutil.copytree("runs", tmp_path / "runs", symlinks=True)
    shutil.copytree(Path("runs/latest").resolve(), tmp_path / "made")
    monkeypatch.chdir(tmp_path)
    before = Path("runs/latest").resolve().name
    monkeypatch.setattr(DriveSimulator, "__init__", loaded)
    searched = found(capsys)
    assert Path("runs/latest").resolve().name != before
    assert f"falsify runs/cart/{before} --replay" in searched["requirements"][0]["replay"]


@pytest.mark.parametrize("option", ["--system", "--plant"])
def test_a_missing_specification_is_told_where_there_is_no_run_either(option, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["falsify", option, "cart.yaml"]) == 2
    assert "specification" in capsys.readouterr().err


def test_a_baseline_draws_as_declared(capsys, tmp_path):
    searched = found(capsys, "--require", "far", "-o", str(tmp_path))
    sampled = found(capsys, "--require", "far", "--random", "-o", str(tmp_path))
    assert "sensitive climbing" in searched["requirements"][0]["strategies"]
    assert sampled["requirements"][0]["strategies"] == {"uniform": 32}
    assert misfits(searched, load_schema("falsify")["properties"]["result"]) == []


def test_points_decide_the_drives():
    run = Run.open("latest")
    simulator = DriveSimulator(run, "none", Setting((0,), 2, 20, 1))
    points = np.random.default_rng(0).random((3, simulator.space.dim))
    together = simulator.simulate(points, 0).margins
    alone = np.concatenate([simulator.simulate(each[None], 0).margins for each in points])
    assert np.allclose(together, alone, atol=1e-6)
    low = np.zeros((1, simulator.space.dim))
    assert simulator.drive(low).states[0, 0, 0] == pytest.approx(-0.5)


def test_a_drive_that_violates_an_assumption_violates_no_requirement():
    simulator = DriveSimulator(Run.open("latest"), "none", Setting((0,), 2, 20, 1))
    points = np.random.default_rng(0).random((8, simulator.space.dim))
    every = simulator.judge(simulator.drive(points)).margins
    assumed = DriveSimulator(simulator.run, simulator.guard, simulator.setting)
    spec = Spec.parse(Source("cart.stl", SPEC + "assume left: x <= 0 m\n"))
    assumed.__dict__["_rules"] = Rules(spec, "cart.stl")
    recording = assumed.drive(points)
    left = (recording.states[:, 0, 0] <= 0.0).reshape(8, 2)
    margins = assumed.judge(recording).margins
    assert 0 < left.sum() < left.size
    assert np.isposinf(margins[~left]).all()
    assert np.allclose(margins[left], every[left], atol=1e-6)
    assert (assumed.simulate(points, 0).admissible == left.any(1)).all()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["falsify", "cart.stl"], "has controls (`u`)"),
        (["falsify", "latest", "--require", "nea"], "did you mean `near`?"),
        (["falsify", "latest", "--guard", "some"], "unknown guard `some`"),
        (["falsify", "latest", "--system", "cart.yaml"], "`--system` is for a specification"),
        (["falsify", "cart.stl", "--agents", "2"], "`--agents` is for a run"),
        (["falsify", "latest", "--replay", "none.json"], "there is no file `none.json`"),
        (["falsify", "latest", "--replay", "cart.yaml"], "`cart.yaml` is not a counterexample"),
        (["falsify", "latest", "--replay", "deep.json"], "`deep.json` is not a counterexample"),
    ],
)
def test_bad_input_is_named(args, message, capsys):
    Path("deep.json").write_text("[" * 200_000)
    assert main(args) == 2
    assert message in capsys.readouterr().err


def test_a_counterexample_of_another_system_is_refused(capsys, tmp_path):
    found(capsys, "--require", "near", "-o", str(tmp_path))
    stored = json.loads((tmp_path / "near.json").read_text())
    unlike = "does not belong to this system"
    damaged = "`point.0` is 'a', not a number"
    for point, said in (([0.5], unlike), ([*stored["point"][:-1], 2.0], unlike), (["a"], damaged)):
        (tmp_path / "other.json").write_text(json.dumps({**stored, "point": point}))
        assert main(["falsify", "latest", "--replay", str(tmp_path / "other.json")]) == 2
        assert said in capsys.readouterr().err


def test_drives_that_end_before_a_verdict_are_no_evidence(capsys):
    args = ["falsify", "latest", "--simulations", "6", "--steps", "4", "--require", "far"]
    assert main([*args, "--json"]) == 4
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("falsify")) == []
    (only,) = document["result"]["requirements"]
    assert (only["verdict"], only["simulations"], only["inconclusive"]) == ("inconclusive", 6, 6)
    assert (only["least"], only["coverage"]) == ("inf", 0.0)
    assert main(args) == 4
    told = capsys.readouterr().out
    assert "no violation" not in told
    assert "far: inconclusive\n  6 simulations ended before a verdict: no evidence" in told
    assert main([*args[:-4], "--require", "far"]) == 0
    assert "far: no violation in 6 simulations" in capsys.readouterr().out
