"""Training from Python shows a bar where somebody sees it."""

from __future__ import annotations

from pathlib import Path

import pytest

import stlc

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("progress", "shown"), [(True, True), (False, False)])
def test_a_terminal_shows_a_bar_unless_it_is_not_wanted(progress, shown, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FORCE_COLOR", "1")  # a terminal, for rich
    task = stlc.compile(stlc.load(ROOT / "specs/traffic.stl"), stlc.System.load(ROOT / "examples/car.yaml"))
    run = stlc.train(task, steps=1, held_out=4, drives=0, progress=progress)
    assert repr(run).endswith(" of 4 held-out starts)")
    assert repr(run).startswith("Run(traffic/0001-")
    assert ("traffic" in capsys.readouterr().out) == shown
