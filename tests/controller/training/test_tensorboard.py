"""Logs for TensorBoard: what they hold, and what is said where they cannot be written."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from stlc.cli.framework.app import main
from stlc.controller.training import tensorboard as logbook
from stlc.controller.training.tensorboard import TensorBoardLogger, find_writer
from stlc.diagnostics import MissingError
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]


class Kept:
    """A writer that remembers."""

    def __init__(self) -> None:
        self.scalars: list[tuple[str, float, int]] = []
        self.texts: list[str] = []
        self.closed = False

    def add_scalar(self, tag: str, value: float, step: int, /) -> None:
        self.scalars.append((tag, value, step))

    def add_text(self, tag: str, text: str, step: int, /) -> None:
        self.texts.append(f"{tag} {step} {text}")

    def close(self) -> None:
        self.closed = True


def test_numbers_stand_under_their_names() -> None:
    kept = Kept()
    log = TensorBoardLogger(kept)
    log.started({"plans": 4})
    row = {"accuracy": 0.9, "feasible": None, "loss": 0.5, "requirements": {"stop": 0.8}, "repaired": 3}
    log.row({"step": 7, **row, "failing": 4})
    log.row({"step": 8, **row, "failing": 0})
    log.close()
    assert kept.scalars[:4] == [
        ("accuracy", 0.9, 7),
        ("loss", 0.5, 7),
        ("requirements/stop", 0.8, 7),
        ("repaired", 0.75, 7),
    ]
    assert [entry for entry in kept.scalars[4:] if entry[0] == "repaired"] == []
    assert "| plans | 4 |" in kept.texts[0]
    assert kept.closed


def test_without_a_writer_nothing_begins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(logbook, "find_spec", lambda _name: None)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(MissingError) as caught:
        find_writer()
    assert caught.value.diagnostics[0].code == "R301"
    words = [
        "train",
        str(ROOT / "specs/traffic.stl"),
        "--log",
        "tensorboard",
        "--runs",
        str(tmp_path / "runs"),
    ]
    assert main(words) == 5
    assert not (tmp_path / "runs").exists()
    assert main([*words[:2], "--log", "diary"]) == 2


@pytest.mark.apart
def test_a_training_leaves_events(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX")
    words = ["train", str(ROOT / "specs/traffic.stl"), "--log", "tensorboard", "--runs", str(tmp_path)]
    options = ["--method", "gradient", "--steps", "52", "--batch", "8", "--held-out", "20", "--no-pictures"]
    assert main([*words, *options]) == 0
    (file,) = (RunDir.newest(tmp_path).path / logbook.FOLDER).iterdir()
    events = file.read_bytes()
    assert all(name in events for name in (b"accuracy", b"requirements/stop_sign", b"engine"))
