"""The same seed and steps give the same weights, however often and wherever a run was killed on its way."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from stlc.controller.run.checkpoint import load_checkpoint
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]
SPECS = ["traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation", "patrol"]
QUICK = ["--batch", "16", "--held-out", "20", "--threads", "1", "--no-pictures"]
START = """
import sys
from stlc.controller.training import learner, loop
loop.SAVE_EVERY = 20
learner.MARGIN_STATES = 16
from stlc.cli.framework.app import main
sys.exit(main(sys.argv[1:]))
"""


def _started(*words: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", START, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def _tensors(run: RunDir) -> dict[str, torch.Tensor]:
    return load_checkpoint(run, **run.hashes).tensors


def _saved(root: Path, process: subprocess.Popen[bytes]) -> RunDir:
    """The run below `root`, once it has a checkpoint."""
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline:
        found = [run for run in RunDir.every(root) if (run.path / "ckpt" / "last.json").is_file()]
        if found:
            return found[0]
        assert process.poll() is None
        time.sleep(0.05)
    raise AssertionError("no checkpoint was written")


@pytest.mark.slow
@pytest.mark.parametrize("spec", SPECS)
def test_a_run_that_is_killed_ends_as_one_that_is_not(spec: str, tmp_path: Path) -> None:
    words = [str(ROOT / "specs" / f"{spec}.stl"), "--steps", "120", "--seed", "5", *QUICK]
    assert _started("train", *words, "--runs", str(tmp_path / "whole")).wait(timeout=400) == 0
    process = _started("train", *words, "--runs", str(tmp_path / "killed"))
    run = _saved(tmp_path / "killed", process)
    time.sleep(random.uniform(0.0, 0.5))
    process.send_signal(signal.SIGKILL)
    process.wait()
    if run.status != "finished":
        again = ["train", "--resume", str(run.path), "--no-pictures"]
        assert _started(*again).wait(timeout=400) == 0
    (whole,) = RunDir.every(tmp_path / "whole")
    left, right = _tensors(whole), _tensors(run)
    assert left.keys() == right.keys()
    assert all(torch.equal(value, right[name]) for name, value in left.items())
    rows, same = ([{**row, "seconds": 0, "s_per_step": 0} for row in each.rows()] for each in (whole, run))
    assert rows == same
    assert [row["step"] for row in rows] == [50, 100]
