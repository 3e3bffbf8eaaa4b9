"""A checkpoint survives kills, full disks, tampering, and is refused by another task."""

from __future__ import annotations

import itertools
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from stlc.controller.run.checkpoint import (
    load_checkpoint,
    never_saved,
    restoring,
    save_checkpoint,
)
from stlc.controller.run.run import load_config
from stlc.diagnostics import MissingError, PluginError, RunError
from stlc.files import File
from stlc.provenance import sha256
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


def _tensors(folder: Path) -> Path:
    return next(folder.glob("step-000001-*.safetensors"))


def test_what_is_saved_is_loaded_and_older_ones_go(run: RunDir) -> None:
    save_checkpoint(run, {"w": torch.ones(2)}, {**HASHES, "step": 2}, step=2)
    loaded = load_checkpoint(run, **HASHES)
    assert loaded.facts["step"] == 2
    assert _value(run) == [1.0, 1.0]
    name = loaded.facts["sha256"][:8]
    assert sorted(path.name for path in (run.path / "ckpt").iterdir()) == [
        "last.json",
        f"step-000002-{name}.json",
        f"step-000002-{name}.safetensors",
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


@pytest.mark.parametrize("files", [0, 1, 2])
def test_a_second_save_at_one_step_keeps_the_first_until_it_is_whole(
    run: RunDir, monkeypatch: pytest.MonkeyPatch, files: int
) -> None:
    real, written = File.write, itertools.count()

    def killed(file: File, data: bytes | str) -> None:
        if next(written) >= files:
            raise KeyboardInterrupt
        real(file, data)

    with monkeypatch.context() as patch:
        patch.setattr(File, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            save_checkpoint(run, {"w": torch.zeros(1)}, HASHES, step=1)
    assert _value(run) == [0.0, 1.0, 2.0]
    save_checkpoint(run, {"w": torch.zeros(1)}, HASHES, step=1)
    assert _value(run) == [0.0]
    assert len(list((run.path / "ckpt").iterdir())) == 3


def test_checkpoints_without_a_hash_in_their_names_are_loaded(run: RunDir) -> None:
    pointer = run.path / "ckpt" / "last.json"
    facts = json.loads(pointer.read_text())
    (run.path / "ckpt" / facts["file"]).rename(run.path / "ckpt" / "step-000001.safetensors")
    pointer.write_text(json.dumps({**facts, "file": "step-000001.safetensors"}))
    assert _value(run) == [0.0, 1.0, 2.0]


def test_what_a_killed_save_leaves_is_removed_by_the_next(run: RunDir) -> None:
    for name in (".step-000002-01234567.89abcdef.safetensors", ".last.89abcdef.json"):
        (run.path / "ckpt" / name).write_bytes(b"part")
    save_checkpoint(run, {"w": torch.zeros(1)}, HASHES, step=2)
    assert len(list((run.path / "ckpt").iterdir())) == 3


def test_a_first_save_that_was_killed_is_none(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path, "traffic", "test")
    assert never_saved(run)
    (run.path / "ckpt").mkdir()
    (run.path / "ckpt" / "step-000001-01234567.safetensors").write_bytes(b"")
    assert never_saved(run)
    save_checkpoint(run, {"w": torch.zeros(1)}, HASHES, step=1)
    assert not never_saved(run)
    (run.path / "ckpt" / "last.json").unlink()
    assert not never_saved(run), "its weights may be wanted"


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
        lambda folder: _tensors(folder).write_bytes(b"short"),
        lambda folder: _tensors(folder).write_bytes(pickle.dumps({"w": 1})),
        lambda folder: _tensors(folder).unlink(),
    ],
)
def test_damage_is_diagnosed(run: RunDir, spoil: object) -> None:
    assert callable(spoil)
    spoil(run.path / "ckpt")
    with pytest.raises(RunError) as caught:
        load_checkpoint(run, **HASHES)
    assert caught.value.diagnostics[0].code == "R101"


@pytest.mark.parametrize(
    "change",
    [
        lambda data: b"\xff" * 8 + data[8:],
        lambda data: data[:8] + data[8:].replace(b"F32", b"F99"),
        lambda data: data[:8] + data[8:].replace(b'"w"', b'"\xff"'),
        lambda data: data + b"more",
        lambda data: data[:5],
    ],
)
def test_weights_that_are_damaged_with_a_sum_that_fits(run: RunDir, change: Callable[[bytes], bytes]) -> None:
    pointer = run.path / "ckpt" / "last.json"
    facts = json.loads(pointer.read_text())
    data = change((run.path / "ckpt" / facts["file"]).read_bytes())
    (run.path / "ckpt" / facts["file"]).write_bytes(data)
    pointer.write_text(json.dumps({**facts, "sha256": sha256(data)}))
    with pytest.raises(RunError) as caught:
        load_checkpoint(run, **HASHES)
    assert caught.value.diagnostics[0].code == "R101"


def test_what_does_not_fit_is_the_fault_of_the_checkpoint(run: RunDir) -> None:
    for broken in (int, lambda: {}["step"], lambda: [][0], lambda: torch.zeros(2).copy_(torch.zeros(3))):
        with pytest.raises(RunError, match=r"R101: the checkpoint in .* is damaged"), restoring(run):
            broken("no number") if broken is int else broken()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("ranks", [1]), ("hold", 1.0), ("hold", []), ("hidden", 3), ("hidden", [10**9]), ("every", 0)],
        *[
            ("lr", None),
            ("seed", True),
            ("seed", 1e308),
            ("plans", 10**30),
            ("share", "x"),
        ],
    ],
)
def test_an_engine_that_is_none(run: RunDir, name: str, value: object) -> None:
    engine = {"method": "guided", "seed": 0, "hidden": [4], "plans": 1, "batch": 2, "hard": 0, "lr": 0.1}
    (run.path / "config.resolved.yaml").write_text(json.dumps(engine))
    assert load_config(run).hidden == (4,)
    (run.path / "config.resolved.yaml").write_text(json.dumps({**engine, name: value}))
    with pytest.raises(RunError) as caught:
        load_config(run)
    assert caught.value.diagnostics[0].code == "R101"


def test_a_method_that_stlc_does_not_have(run: RunDir) -> None:
    engine = {"method": "magic", "seed": 0, "hidden": [4], "plans": 1, "batch": 2, "hard": 0, "lr": 0.1}
    (run.path / "config.resolved.yaml").write_text(json.dumps(engine))
    with pytest.raises(PluginError, match="needs the method `magic`"):
        load_config(run)


@pytest.mark.parametrize(
    "text", ["[" * 9000, "[]", '{"overrides": []}', '{"overrides": {"a": 1}}', '{"seed": "one"}']
)
def test_records_that_are_damaged(run: RunDir, text: str) -> None:
    (run.path / "run.json").write_text(text)
    with pytest.raises(RunError) as caught:
        run.record()
    assert caught.value.diagnostics[0].code == "R101"
    for rows in ("3\n", "[" * 9000 + "\n"):
        (run.path / "train.jsonl").write_text(rows)
        with pytest.raises(RunError):
            run.rows()
