"""`stlc train --seeds`: a run a seed, side by side, and a table at the end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.controller.parallel.jobs import Job, JobResult
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[4]
SPEC = str(ROOT / "specs/traffic.stl")
QUICK = ["--batch", "8", "--held-out", "20", "--no-pictures"]


def returned(job: Job, seed: int, code: int) -> JobResult:
    if seed == 1:
        return JobResult(job, code, {"result": None}, "error[R401]: training diverged", 1)
    result = {
        "run": f"runs/traffic/000{seed}-a",
        "seconds": 61.2,
        "accuracy": 0.95 + 0.01 * seed,
        "interval": [0.94, 0.98],
        "held_out": 100,
        "requirements": {"stop": 0.96, "go": 0.99},
        "feasible": 0.97,
        "searched": 100,
        "steps": 9,
        "schedule": None,
        "closed_loop": {
            "recommended": "full",
            "guards": [
                {"guard": "none", "drives": 20, "satisfied": 20, "share": 1.0},
                {"guard": "full", "drives": 20, "satisfied": 17 + seed, "share": 0.85 + 0.05 * seed},
            ],
        },
    }
    return JobResult(job, 0, {"result": result}, "", 1)


@pytest.mark.apart
@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_every_seed_is_a_run_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *, real: bool
) -> None:
    """In this process, for the processes themselves see `test_jobs.py`."""

    def here(executor, jobs, begun):
        assert executor.workers == 2
        for job in jobs:
            begun(job)
            code = main(["train", *job.arguments, "--threads", "1", "--json"])
            yield JobResult(job, code, json.loads(capsys.readouterr().out), "", 1)

    if not real:
        monkeypatch.setattr("stlc.controller.parallel.jobs.LocalExecutor.run", here)
    words = ["train", SPEC, "--seeds", "3..4", "--jobs", "2", "--steps", "2", "--set", "T_red=3s", *QUICK]
    code = main([*words, "--name", "pair", "--runs", str(tmp_path), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code == max(run["exit_code"] for run in document["result"]["runs"])
    assert misfits(document, load_schema("train/1")) == []
    records = [run.record() for run in RunDir.every(tmp_path)]
    assert sorted(record["seed"] for record in records) == [3, 4]
    assert all(record["overrides"] == {"T_red": "3s"} for record in records)
    assert all(record["threads"] == 1 for record in records)
    assert {run.name.partition("-")[2] for run in RunDir.every(tmp_path)} == {"pair-seed3", "pair-seed4"}


@pytest.mark.parametrize(("ended", "code"), [(3, 3), (-9, 70)])
def test_the_table_has_a_line_for_each_and_the_mean_of_those_that_ended_well(
    ended: int, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pretended(executor, jobs, begun):
        assert executor.workers == 3
        for job in reversed(jobs):
            begun(job)
            yield returned(job, int(job.arguments[job.arguments.index("--seed") + 1]), ended)

    monkeypatch.setattr("stlc.controller.parallel.jobs.LocalExecutor.run", pretended)
    assert main(["train", SPEC, "--seeds", "0..2", "--jobs", "3", "--steps", "2"]) == code
    told = capsys.readouterr()
    header, *lines = told.out.splitlines()
    assert header.split()[:3] == ["seed", "drives", "accuracy"]
    drives = ["0", "17", "of", "20,", "full"]
    assert lines[0].split()[:9] == [*drives, "0.9500", "[0.9400,", "0.9800]", "0.9700"]
    assert lines[1].split() == ["1", "exit", "code", str(ended)]
    assert lines[3].split()[:5] == ["mean", "0.9600", "0.9500", "to", "0.9700"]
    assert f"seed 1 broke off with exit code {ended}\nerror[R401]: training diverged" in told.err


@pytest.mark.slow
def test_every_specification_is_trained_for_and_one_that_fails_stops_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.stl"
    broken.write_text("require a: always[0, ")
    words = ["train", str(broken), SPEC, "--jobs", "2", "--steps", "2", *QUICK]
    code = main([*words, "--seed", "3", "--runs", str(tmp_path / "runs"), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("train/1")) == []
    bad, good = document["result"]["runs"]
    assert code == document["exit_code"] == bad["exit_code"] == 3
    assert bad["why"].startswith("error[E")
    assert (bad["spec"], good["spec"], good["seed"]) == (str(broken), SPEC, 3)
    (run,) = RunDir.every(tmp_path / "runs")
    assert (run.shown, run.record()["seed"], run.status) == (good["run"], 3, "finished")


def test_the_table_of_several_specifications_has_a_mean_for_each(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pretended(executor, jobs, begun):
        assert (len({job.name for job in jobs}), executor.workers) == (6, 1)
        for job in jobs:
            begun(job)
            yield returned(job, int(job.arguments[job.arguments.index("--seed") + 1]), 3)

    monkeypatch.setattr("stlc.controller.parallel.jobs.LocalExecutor.run", pretended)
    assert main(["train", "a.stl", "b.stl", "a.stl", "--seeds", "0..2", "--steps", "2"]) == 3
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split()[:2] == ["specification", "seed"]
    firsts = [tuple(line.split()[:2]) for line in lines]
    assert firsts == [(name, row) for name in ("a.stl", "b.stl") for row in ("0", "1", "2", "mean")]


@pytest.mark.parametrize(
    "options",
    [
        [SPEC.replace("traffic", "ship_safe"), "--system", "car.yaml"],
        ["--jobs", "2", "--cluster", "local"],
        ["--resume", "latest", "--cluster", "local"],
    ],
)
def test_options_that_mean_nothing_for_many(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", SPEC] if "--resume" not in options else ["train"]
    assert main([*words, *options, "--runs", str(tmp_path / "runs")]) == 2
    assert "--" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "options",
    [["--seeds", "0..2", "--seed", "1"], ["--jobs", "2"], ["--seeds", "2..1"], ["--seeds", "0", "--lr", "0"]],
)
def test_options_that_contradict_each_other(options: list[str], tmp_path: Path) -> None:
    assert main(["train", SPEC, "--steps", "1", "--runs", str(tmp_path / "runs"), *options]) == 2
    assert not (tmp_path / "runs").exists()
