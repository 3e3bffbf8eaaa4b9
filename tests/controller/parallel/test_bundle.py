"""Jobs that travel: what they read goes along, their runs come back, and nothing leads out of a folder."""

from __future__ import annotations

import io
import itertools
import shutil
import tarfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from stlc.controller.parallel.bundle import (
    BundleResult,
    JobBundle,
    claimed,
    import_run,
    input_files,
    pack,
    run_bundle,
    unpack,
)
from stlc.controller.parallel.jobs import Job, core_shares
from stlc.controller.training.checkpoint import load_checkpoint, save_checkpoint
from stlc.rundir import RunDir, every_run

ROOT = Path(__file__).parents[3]
QUICK = ("--method", "gradient", "--held-out", "20", "--batch", "8", "--threads", "1", "--no-pictures")


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a specification and its system in a folder beside."""
    home = tmp_path / "project"
    (home / "specs").mkdir(parents=True)
    (home / "models").mkdir()
    car = (ROOT / "examples/car.yaml").read_text()
    (home / "models/base.yaml").write_text(car)
    (home / "models/car.yaml").write_text("extends: base.yaml\n")
    text = (ROOT / "specs/traffic.stl").read_text().replace('"../examples/car.yaml"', '"../models/car.yaml"')
    (home / "specs/drive.stl").write_text(text)
    (home / "specs/driving_rules.stl").write_text((ROOT / "specs/driving_rules.stl").read_text())
    monkeypatch.chdir(home)
    return home


def job(*more: str, runs: Path = Path("runs")) -> Job:
    spec = Path("specs/drive.stl")
    words = (str(spec), "--steps", "2", "--runs", str(runs), *QUICK, *more)
    return Job("one", words, input_files(spec), runs)


def test_what_a_training_reads(project: Path) -> None:
    read = {
        path.resolve().relative_to(project.resolve()).as_posix()
        for path in input_files(Path("specs/drive.stl"))
    }
    assert {"specs/drive.stl", "specs/driving_rules.stl", "models/car.yaml", "models/base.yaml"} <= read
    (project / "specs/broken.stl").write_text("require a: always[0, ")
    assert input_files(Path("specs/broken.stl")) == (Path("specs/broken.stl"),)
    assert input_files(Path("specs/none.stl")) == ()


@pytest.mark.slow
def test_a_worker_that_does_not_see_the_folders_sends_the_run(project: Path) -> None:
    home = project / "results"
    sent = JobBundle.of(job("--name", "far", runs=home), cores=1)
    assert sent.shared
    back = run_bundle(replace(sent, probe="/not/here"))
    assert (back.code in (0, 1), back.cores) == (True, 1), back.said
    assert every_run(home) == []
    RunDir.create(home, "traffic", "earlier")
    document = import_run(job(runs=home), sent, back).document
    sent.close()
    (run,) = every_run(home)
    assert run.name == "0002-far"
    assert run.status == "finished"
    assert document is not None
    assert document["result"]["run"] == run.shown
    record = run.record()
    assert record["spec_path"] == "specs/drive.stl"
    assert not any("/stlc-" in str(value) for value in record.values())
    assert list(home.glob(".probe-*")) == []


@pytest.mark.usefixtures("project")
def test_a_worker_that_sees_the_folders_leaves_the_run_there() -> None:
    sent = JobBundle.of(job("--stepps", "2"), cores=1)
    back = run_bundle(sent)
    assert (back.code, back.run, back.files) == (2, None, b"")
    assert import_run(job(), sent, back).why.startswith("error[U101]")


def test_a_run_that_was_sent_is_written_over(project: Path) -> None:
    run = RunDir.create(Path("runs"), "drive", "old")
    run.update({"status": "interrupted"})
    going = Job("on", ("--resume", str(run.path)), (run.path,), Path("runs"))
    sent = JobBundle.of(going, 1)
    (project / "later.json").write_text('{"status": "finished"}')
    files = pack({"run.json": project / "later.json"})
    import_run(going, sent, BundleResult(0, "", "", 1, str(project.resolve() / run.path), files))
    assert [(each.name, each.status) for each in every_run(Path("runs"))] == [("0001-old", "finished")]


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
    files = pack({path.name: path for path in sorted(after.iterdir(), reverse=True)})
    going = Job("on", ("--resume", str(run.path)), (run.path,), Path("runs"))
    sent = JobBundle.of(going, 1)
    back = BundleResult(0, "", "", 1, str(project.resolve() / run.path), files)
    real, moved = Path.replace, itertools.count()

    def killed(path: Path, target: Path) -> Path:
        if next(moved) >= killed_after:
            raise KeyboardInterrupt
        return real(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with suppress(KeyboardInterrupt):
            import_run(going, sent, back)
    # two files of the checkpoint, the pointer to it, the record
    assert load_checkpoint(run, **hashes).tensors["w"].tolist() == [float(killed_after >= 3)]
    assert run.status == ("finished" if killed_after >= 4 else "interrupted")
    import_run(going, sent, back)
    assert run.status == "finished"
    assert load_checkpoint(run, **hashes).tensors["w"].tolist() == [1.0]
    assert [path.name for path in run.path.parent.glob(".*")] == []


@pytest.mark.usefixtures("project")
def test_another_version_is_refused() -> None:
    back = run_bundle(replace(JobBundle.of(job(), 1), version="0.0.0"))
    assert back.code == 5
    assert "0.0.0 is needed" in back.said


def test_archives_hold_files_and_folders(tmp_path: Path) -> None:
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/c.bin").write_bytes(bytes(range(256)))
    unpack(pack({"x": tmp_path / "a", "y.bin": tmp_path / "a/b/c.bin"}), tmp_path / "out")
    assert (
        (tmp_path / "out/x/b/c.bin").read_bytes()
        == (tmp_path / "out/y.bin").read_bytes()
        == bytes(range(256))
    )


@pytest.mark.parametrize(("name", "link"), [("../out.txt", ""), ("in", "../../secret")])
def test_nothing_leads_out_of_the_folder(name: str, link: str, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        entry = tarfile.TarInfo(name)
        if link:
            entry.type, entry.linkname = tarfile.SYMTYPE, link
        archive.addfile(entry, io.BytesIO(b""))
    with pytest.raises(tarfile.FilterError):
        unpack(buffer.getvalue(), tmp_path / "folder")
    assert not (tmp_path / "out.txt").exists()


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
