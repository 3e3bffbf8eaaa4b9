"""A checkpoint survives kills, full disks, tampering, and is refused by another task."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import pytest
import torch

from stlc.controller.checkpoint import load_checkpoint, save_checkpoint
from stlc.diagnostics import MissingError, RunError
from stlc.rundir import RunDir

HASHES = {"spec_hash": "a" * 64, "system_hash": "b" * 64}


@pytest.fixture
def run(tmp_path: Path) -> RunDir:
    folder = RunDir.create(tmp_path, "traffic", "test")
    folder.update({"status": "running"})
    save_checkpoint(folder, {"w": torch.arange(3.0)}, HASHES, step=1)
    return folder


def _value(run: RunDir) -> list[float]:
    return load_checkpoint(run, **HASHES).tensors["w"].tolist()


def test_what_is_saved_is_loaded_and_older_ones_go(run: RunDir) -> None:
    save_checkpoint(run, {"w": torch.ones(2)}, {**HASHES, "step": 2}, step=2)
    loaded = load_checkpoint(run, **HASHES)
    assert loaded.facts["step"] == 2
    assert _value(run) == [1.0, 1.0]
    assert sorted(path.name for path in (run.path / "ckpt").iterdir()) == [
        "last.json",
        "step-000002.json",
        "step-000002.safetensors",
    ]


@pytest.mark.parametrize("name", ["replace", "fsync"])
@pytest.mark.parametrize("survived", [0, 1, 2])
def test_a_full_disk_at_any_moment_keeps_the_last_good_one(
    run: RunDir, monkeypatch: pytest.MonkeyPatch, name: str, survived: int
) -> None:
    real, calls = getattr(os, name), []

    def fail(*args: object) -> object:
        calls.append(1)
        if len(calls) > survived:
            raise OSError(28, "No space left on device")
        return real(*args)

    monkeypatch.setattr(os, name, fail)
    with pytest.raises(MissingError) as caught:
        save_checkpoint(run, {"w": torch.zeros(1)}, HASHES, step=2)
    monkeypatch.undo()
    assert caught.value.diagnostics[0].code == "R201"
    assert _value(run) == [0.0, 1.0, 2.0]
    assert not [path for path in (run.path / "ckpt").iterdir() if path.name.startswith(".")]


def test_another_task_is_refused(run: RunDir) -> None:
    with pytest.raises(RunError) as caught:
        load_checkpoint(run, spec_hash="c" * 64, system_hash=HASHES["system_hash"])
    assert caught.value.diagnostics[0].code == "R102"
    assert "another specification" in caught.value.diagnostics[0].message


@pytest.mark.parametrize(
    "spoil",
    [
        lambda folder: (folder / "last.json").write_text("{"),
        lambda folder: (folder / "last.json").write_text("[]"),
        lambda folder: (folder / "last.json").write_text('{"file": "../../run.json"}'),
        lambda folder: (folder / "last.json").unlink(),
        lambda folder: (folder / "step-000001.safetensors").write_bytes(b"short"),
        lambda folder: (folder / "step-000001.safetensors").write_bytes(pickle.dumps({"w": 1})),
        lambda folder: (folder / "step-000001.safetensors").unlink(),
    ],
)
def test_damage_is_diagnosed(run: RunDir, spoil: object) -> None:
    assert callable(spoil)
    spoil(run.path / "ckpt")
    with pytest.raises(RunError) as caught:
        load_checkpoint(run, **HASHES)
    assert caught.value.diagnostics[0].code == "R101"
