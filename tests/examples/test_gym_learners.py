"""The examples that train in environments run."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, monkeypatch: pytest.MonkeyPatch, *options: str) -> None:
    monkeypatch.setattr(sys, "argv", [name, *options])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


@pytest.mark.apart
def test_ppo_in_one_file(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gymnasium")
    run("gym_ppo.py", monkeypatch, "navigation", "--envs", "16", "--updates", "3", "--reward", "task")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["update 1", "update 3"]
    assert all("satisfied" in line for line in lines)


@pytest.mark.apart
@pytest.mark.parametrize("method", ["ppo", "sac"])
def test_stable_baselines3(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("stable_baselines3")
    from safetensors.torch import load_file

    out = tmp_path / "policy.safetensors"
    options = ("--method", method, "--envs", "4", "--steps", "400", "--out", str(out))
    run("gym_sb3.py", monkeypatch, "traffic", *options)
    assert "after 400 steps" in capsys.readouterr().out
    assert load_file(out)
