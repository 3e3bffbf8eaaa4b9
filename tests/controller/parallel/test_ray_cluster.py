"""Runs on a Ray cluster of this machine; without Ray, how to get it."""

from __future__ import annotations

import json
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.__main__ import main as measure
from stlc.cli.framework.app import main
from stlc.controller.parallel.elsewhere import SeenFile
from stlc.controller.parallel.jobs import Job
from stlc.controller.parallel.ray_cluster import RayWorkers
from stlc.controller.parallel.ray_jobs import RayExecutor
from stlc.controller.parallel.workers import CallFiles
from stlc.diagnostics import MissingError
from stlc.extras import installation
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]
SPECS = [str(ROOT / "specs" / name) for name in ("traffic.stl", "ship_safe.stl")]
QUICK = ["--steps", "5", "--batch", "8", "--held-out", "20", "--no-pictures"]


@pytest.fixture
def without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)


@pytest.mark.usefixtures("without_ray")
@pytest.mark.parametrize(
    ("program", "command"),
    [
        (main, ["train", *SPECS]),
        pytest.param(measure, ["paper", "--only", "traffic"], marks=pytest.mark.apart),
    ],
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
    assert installation("cluster") in capsys.readouterr().err
    assert list(tmp_path.glob("*")) == []


class Ray:
    """A cluster of one worker in this process, whose working directory is the one that it was given."""

    class exceptions:  # noqa: N801
        RayError = type("RayError", (Exception,), {})
        RayTaskError = type("RayTaskError", (RayError,), {})
        RuntimeEnvSetupError = type("RuntimeEnvSetupError", (RayError,), {})

    def __init__(self, folder: Path, limit: int = 1000) -> None:
        self.folder, self.limit, self.connected = folder, limit, False

    def is_initialized(self) -> bool:
        return self.connected

    def init(self, runtime_env: dict[str, str] | None, **_: Any) -> None:
        if runtime_env is not None and not self.connected:
            shutil.copytree(runtime_env["working_dir"], self.folder, dirs_exist_ok=True)
            if sum(path.stat().st_size for path in self.folder.iterdir()) > self.limit:
                raise self.exceptions.RuntimeEnvSetupError("Failed.\nThe package is too large.\nMore.")
        self.connected = True

    def shutdown(self) -> None:
        self.connected = False

    def remote(self, function: Any) -> Any:
        def call(argument: Any) -> Task:
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(self.folder)
                return Task([function(argument)])

        return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=call))

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 1.0}

    def wait(self, tasks: list[Task]) -> tuple[list[Task], list[Task]]:
        return tasks[:1], tasks[1:]

    def get(self, task: Task) -> Any:
        return task.value[0]


@dataclass(eq=False)
class Task:
    value: list[Any]


def texts(paths: tuple[str, ...]) -> list[str]:
    return [Path(path).read_text() for path in paths]


@pytest.fixture
def ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ray:
    (tmp_path / "worker").mkdir()
    for name in ("spec.stl", "a.csv", "b.csv"):
        (tmp_path / name).write_text(f"text of {name}")
    found = Ray(tmp_path / "worker")
    monkeypatch.setitem(sys.modules, "ray", found)  # type: ignore[arg-type]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(SeenFile, "here", False)
    return found


@pytest.mark.parametrize("connected", [False, True])
def test_files_of_every_call_are_sent_once(ray: Ray, connected: bool) -> None:
    ray.connected = connected
    with RayWorkers("auto", files=[Path("spec.stl")]) as workers:
        assert [path.read_text() for path in ray.folder.iterdir()] == (
            [] if connected else ["text of spec.stl"]
        )
        found = workers.results(
            texts,
            [("spec.stl", "a.csv"), ("spec.stl", "b.csv"), ("spec.stl",)],
            files=lambda names: CallFiles(tuple(map(Path, names))),
        )
        assert sorted(each.value for each in found) == [
            ["text of spec.stl"],
            ["text of spec.stl", "text of a.csv"],
            ["text of spec.stl", "text of b.csv"],
        ]


def test_a_cluster_that_does_not_take_the_files(ray: Ray) -> None:
    ray.limit = 3
    with pytest.raises(MissingError) as found, RayWorkers("10.0.0.1:6379", files=[Path("spec.stl")]):
        pass
    (finding,) = found.value.diagnostics
    assert (finding.code, finding.note) == ("R302", ("The package is too large.",))
    assert "the cluster at `10.0.0.1:6379` does not take the input files" in finding.message


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
    assert sorted(run.path.parent.name for run in RunDir.every(tmp_path)) == ["ship_safe", "traffic"]
    assert {run.status for run in RunDir.every(tmp_path)} == {"finished"}
    assert {run.path for run in RunDir.every(tmp_path)} == {
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
    while not any(run.record().get("engine") for run in RunDir.every(tmp_path)):
        time.sleep(0.05)
    waiting.close()
    (run,) = RunDir.every(tmp_path)
    assert run.status == "interrupted"


def test_no_cluster_answers(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert main(["train", SPECS[0], *QUICK, "--cluster", "auto"]) == 5
    assert "error[R302]: there is no cluster at `auto`" in capsys.readouterr().err
