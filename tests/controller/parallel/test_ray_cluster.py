"""Runs on a Ray cluster of this machine; without Ray, how to get it."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from benchmarks.__main__ import main as measure
from stlc.cli.framework.app import main
from stlc.controller.parallel.elsewhere import SeenFile
from stlc.controller.parallel.jobs import Job
from stlc.controller.parallel.ray_jobs import RayExecutor
from stlc.rundir import every_run

ROOT = Path(__file__).parents[3]
SPECS = [str(ROOT / "specs" / name) for name in ("traffic.stl", "ship_safe.stl")]
QUICK = ["--steps", "5", "--batch", "8", "--held-out", "20", "--no-pictures"]


@pytest.fixture
def without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)


@pytest.mark.usefixtures("without_ray")
@pytest.mark.parametrize(
    ("program", "command"), [(main, ["train", *SPECS]), (measure, ["paper", "--only", "traffic"])]
)
def test_without_ray_it_is_said_how_to_get_it(
    program: Any,
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert program([*command, "--steps", "5", "--cluster", "local"]) == 5
    assert "pip install 'stlc[cluster]'" in capsys.readouterr().err
    assert list(tmp_path.glob("*")) == []


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("shared", [True, False])
def test_specifications_are_trained_for_on_a_cluster(
    shared: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    if not shared:  # no machine recognises the files of the caller
        monkeypatch.setattr(SeenFile, "of", lambda path: SeenFile(str(path), -1, 0))
    code = main(["train", *SPECS, *QUICK, "--runs", str(tmp_path), "--cluster", "local", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code
    assert [run["spec"] for run in document["result"]["runs"]] == SPECS
    assert sorted(run.path.parent.name for run in every_run(tmp_path)) == ["ship_safe", "traffic"]
    assert {run.status for run in every_run(tmp_path)} == {"finished"}
    assert {run.path for run in every_run(tmp_path)} == {
        Path(run["run"]).resolve() for run in document["result"]["runs"]
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_what_is_no_longer_wanted_is_saved(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    long = Job("long", (SPECS[0], "--steps", "100000", "--runs", str(tmp_path), *QUICK[2:]), (), tmp_path)
    bad = Job("bad", ("--stepps", "2"), (), tmp_path)
    waiting = RayExecutor("local").run([long, bad])
    assert next(waiting).job.name == "bad"
    while not any(run.record().get("engine") for run in every_run(tmp_path)):
        time.sleep(0.05)
    waiting.close()
    (run,) = every_run(tmp_path)
    assert run.status == "interrupted"


def test_no_cluster_answers(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert main(["train", SPECS[0], *QUICK, "--cluster", "auto"]) == 5
    assert "error[R302]: there is no cluster at `auto`" in capsys.readouterr().err
