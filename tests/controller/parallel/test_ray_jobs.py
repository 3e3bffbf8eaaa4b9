"""Jobs that travel: their files go along, their runs come back, and nothing leads out of a folder."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from stlc.controller.parallel.elsewhere import RemoteCall, RemoteValue, absolute, answer, linked
from stlc.controller.parallel.jobs import Job, JobResult, core_shares
from stlc.controller.parallel.ray_jobs import RayExecutor, TrainingCall, claimed, received, trained
from stlc.controller.parallel.workers import CallFiles, LostCall
from stlc.controller.problem.inputs import input_files
from stlc.controller.run.checkpoint import load_checkpoint, save_checkpoint
from stlc.diagnostics import RunError
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]
QUICK = ("--method", "gradient", "--held-out", "20", "--batch", "8", "--threads", "1", "--no-pictures")


def job(*more: str, runs: Path = Path("runs")) -> Job:
    spec = Path("specs/drive.stl")
    words = (str(spec), "--steps", "2", "--runs", str(runs), *QUICK, *more)
    return Job("one", words, input_files(spec), runs)


class Workers:
    """Workers in this process instead of a cluster; they see the caller's files or not."""

    sees = True
    change: ClassVar[dict[str, str]] = {}

    def __init__(self, _address: str, _cores: int, _gpus: int, files: list[Path]) -> None:
        self.folder = Path("working_dir").resolve()
        self.folder.mkdir()
        self.linked = linked(files, self.folder)
        self.answers: Iterator[tuple[int, RemoteValue | LostCall]] = iter(())

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder)

    def submit(self, key: int, function: object, argument: object, files: CallFiles) -> None:
        call = RemoteCall.of(function, argument, files, self.linked)  # type: ignore[arg-type]
        assert call.shared
        if not self.sees:
            (probe,) = call.others
            call = call.with_files()
            assert call.sent == {str(probe): b""}
            call = replace(call, inputs=tuple(replace(each, changed=0) for each in call.inputs))
        call = replace(call, **self.change)
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(self.folder)
            self.answers = itertools.chain(self.answers, iter([(key, answer(call))]))

    def answered(self) -> tuple[int, RemoteValue | LostCall]:
        return next(self.answers)


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> type[Workers]:
    class Ours(Workers):
        pass

    monkeypatch.setattr("stlc.controller.parallel.ray_jobs.RayWorkers", Ours)
    return Ours


@pytest.mark.slow
def test_a_worker_that_does_not_see_the_folders_sends_the_run(project: Path, workers: type[Workers]) -> None:
    workers.sees, home = False, project / "results"
    RunDir.create(home, "traffic", "earlier")
    (back,) = RayExecutor("far").run([job("--name", "far", runs=home)])
    assert (back.code in (0, 1), back.cores) == (True, 1), back.said
    (run,) = RunDir.every(home)
    assert run.name == "0002-far"
    assert run.status == "finished"
    assert back.result["run"] == run.shown
    record = run.record()
    assert record["spec_path"] == "specs/drive.stl"
    assert not any("/stlc-" in str(value) for value in record.values())
    assert list(home.glob(".probe-*")) == []


@pytest.mark.slow
@pytest.mark.usefixtures("project")
def test_a_run_is_continued_elsewhere(workers: type[Workers]) -> None:
    workers.sees = False
    (first,) = RayExecutor("far").run([job()])
    (run,) = RunDir.every(Path("runs"))
    other = RunDir.create(Path("runs"), "traffic", "other")
    other.update({"status": "interrupted"})
    words = ("--resume", str(run.path), "--steps", "4", "--no-pictures")
    (back,) = RayExecutor("far").run([Job("on", words, (run.path,), Path("runs"))])
    assert back.result["run"] == first.result["run"] == run.shown
    assert [(each.name, each.status) for each in RunDir.every(Path("runs"))] == [
        (run.name, "finished"),
        (other.name, "interrupted"),
    ]
    assert run.record()["steps"] == 4


@pytest.mark.usefixtures("project", "workers")
def test_a_worker_that_sees_the_folders_leaves_the_run_there() -> None:
    (back,) = RayExecutor("near").run([job("--stepps", "2")])
    assert back.code == 2
    assert back.why.startswith("error[U101]")
    assert list(Path("runs").iterdir()) == []


@pytest.mark.usefixtures("project")
def test_a_job_whose_probe_is_deleted_ends() -> None:
    ended = trained(TrainingCall(job("--name", "off"), 1, Path("deleted")))
    assert ended.code != 0


@pytest.mark.parametrize("killed_after", range(5))
def test_a_run_that_was_sent_is_whole_at_any_moment(
    killed_after: int, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, after = RunDir.create(Path("runs"), "drive", "old"), project / "after"
    run.update({"status": "interrupted"})
    hashes = {"spec_hash": "a", "system_hash": "b"}
    save_checkpoint(run, {"w": torch.zeros(1)}, hashes, step=1)
    shutil.copytree(run.path, after)
    save_checkpoint(RunDir(after), {"w": torch.ones(1)}, hashes, step=2)
    RunDir(after).finish("finished")
    going = Job("on", ("--resume", str(run.path)), (run.path,), Path("runs"))
    files = {
        str(absolute(run.path) / path.relative_to(after)): path.read_bytes()
        for path in sorted(after.rglob("*"), reverse=True)
        if path.is_file()
    }
    back = RemoteValue(JobResult(going, 0, None, "", 1), outputs=files)
    real, moved = Path.replace, itertools.count()

    def killed(path: Path, target: Path) -> Path:
        if next(moved) >= killed_after:
            raise KeyboardInterrupt
        return real(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with suppress(KeyboardInterrupt):
            received(going, back)
    # two files of the checkpoint, the pointer to it, the record
    assert load_checkpoint(run, **hashes).tensors["w"].tolist() == [float(killed_after >= 3)]
    assert run.status == ("finished" if killed_after >= 4 else "interrupted")
    received(going, back)
    assert run.status == "finished"
    assert load_checkpoint(run, **hashes).tensors["w"].tolist() == [1.0]
    assert [path.name for path in run.path.parent.glob(".*")] == []


def test_a_run_that_leads_elsewhere_is_not_sent(project: Path) -> None:
    run = RunDir.create(Path("runs"), "drive", "old")
    run.update({"status": "interrupted"})
    (run.path / "more.json").symlink_to(project / "models/car.yaml")
    with pytest.raises(RunError, match="R110"):
        list(RayExecutor("local").run([Job("on", ("--resume", str(run.path)), (run.path,), Path("runs"))]))
    assert list(Path("runs").glob(".probe-*")) == []


@pytest.mark.parametrize("name", ["../out.txt", "in/../../out.txt", "linked/out.txt"])
def test_nothing_that_comes_back_leads_out_of_the_folder(name: str, project: Path) -> None:
    run = RunDir.create(Path("runs"), "drive", "old")
    run.update({"status": "interrupted"})
    (run.path / "linked").symlink_to(project)
    going = Job("on", ("--resume", str(run.path)), (run.path,), Path("runs"))
    files = {f"{absolute(run.path)}/{name}": b"", f"{absolute(run.path)}/run.json": b"{}"}
    with pytest.raises(RunError, match="R110"):
        received(going, RemoteValue(JobResult(going, 0, None, "", 1), outputs=files))
    assert list(project.rglob("out.txt")) == []
    assert run.status == "interrupted"


@pytest.mark.usefixtures("project")
def test_another_version_is_refused(workers: type[Workers]) -> None:
    workers.change = {"version": "0.0.0"}
    (back,) = RayExecutor("far").run([job()])
    assert back.code == 5
    assert "0.0.0 is needed" in back.why


def test_a_lost_job_has_the_code_of_a_killed_process() -> None:
    lost = received(Job("one", ()), LostCall("its node went down"))
    assert (lost.code, lost.why, lost.result) == (-9, "its node went down", {})


def test_two_jobs_have_different_cores(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    everything = core_shares(1)[0]
    with claimed(1) as first:
        assert len(first) == 1
        with claimed(len(everything)) as rest:
            assert rest == everything  # not so many are free
        if len(everything) > 1:
            with claimed(1) as second:
                assert not first & second
    with claimed(1) as again:
        assert again == first
