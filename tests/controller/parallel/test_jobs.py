"""Runs in processes of their own: one that breaks off costs no other, one that is no longer wanted saves."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.controller.parallel.jobs import Job, LocalExecutor, core_shares
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]
SPEC = str(ROOT / "specs" / "traffic.stl")
QUICK = ("--held-out", "20", "--batch", "8", "--threads", "1", "--no-pictures")


@given(st.integers(1, 200))
def test_every_job_has_cores_and_no_core_is_left_out(jobs: int) -> None:
    shares = core_shares(jobs)
    everything = core_shares(1)[0]
    assert len(shares) == jobs
    assert all(shares)
    assert frozenset().union(*shares) == everything
    if jobs <= len(everything):
        assert sum(map(len, shares)) == len(everything)


def test_what_breaks_off_is_told() -> None:
    begun: list[str] = []
    bad = [Job(name, ("--stepps", "2")) for name in ("a", "b")]
    found = list(LocalExecutor(1).run(bad, lambda job: begun.append(job.name)))
    assert begun == [back.job.name for back in found] == ["a", "b"]
    assert all((back.code, back.result) == (2, {}) for back in found)
    assert found[0].document is not None
    assert found[0].document["diagnostics"][0]["code"] == "U101"


@pytest.mark.apart
def test_what_is_no_longer_wanted_is_saved(tmp_path: Path) -> None:
    long = Job("long", (SPEC, "--steps", "100000", "--runs", str(tmp_path), *QUICK))
    bad = Job("bad", ("--stepps", "2"))
    waiting = LocalExecutor(2).run([long, bad])
    assert next(waiting).job.name == "bad"
    deadline = time.monotonic() + 60
    while not any(run.record().get("engine") for run in RunDir.every(tmp_path)):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    waiting.close()
    (run,) = RunDir.every(tmp_path)
    assert run.status == "interrupted"
    assert (run.path / "ckpt" / "last.json").is_file() or not list(run.rows()), "nothing done is lost"
