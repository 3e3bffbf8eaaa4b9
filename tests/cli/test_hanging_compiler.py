"""A compiler that hangs: every command ends, says so once, and does without it."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest

from stlc import native, toolchain
from stlc.cli.framework.app import main
from stlc.compile.backends.array import kernel as window_kernel
from stlc.controller.training.config import TrainConfig
from stlc.trace.formats import cells as trace_cells
from stlc.trace.formats import csv as trace_csv

TRAIN = ["train", "specs/cart.stl", "--steps", "2", "--held-out", "40", "--no-pictures"]
SIMULATE = ["simulate", "--backup", "--seeds", "0", "--steps", "2", "--agents", "2", "--no-pictures"]
CHECK = ["check", "low.stl", "big.csv"]
SAID = "did nothing for 0.2 s and was ended"


@pytest.fixture
def hanging(monkeypatch, tmp_path):
    """A project, and a compiler that notes what it is asked, then sleeps; gives the notes."""
    monkeypatch.chdir(tmp_path)
    assert main(["init"]) == 0
    Path("low.stl").write_text("signal x\nrequire low: always x < 5\n")
    Path("big.csv").write_text("t,x\n" + "".join(f"{k},1\n" for k in range(200)))
    compiler = tmp_path / "cc"
    compiler.write_text('#!/bin/sh\necho "$1" >> "$0.asked"\nexec sleep 1000\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for module, name, value in (
        (toolchain, "IDLE", 0.2),
        (toolchain, "_known", {}),
        (toolchain, "_versions", {}),
        (native, "_temporary", {}),
        (trace_csv, "LARGE", 1),
    ):
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(
        "stlc.controller.training.config.TrainConfig", functools.partial(TrainConfig, held_out=64)
    )
    monkeypatch.setattr("stlc.controller.training.learner.MARGIN_STATES", 16)
    caches = (trace_cells._library, window_kernel.kernel_library)
    for each in caches:
        each.cache_clear()
    yield tmp_path / "cc.asked"
    for each in caches:
        each.cache_clear()


def test_every_command_ends(hanging, capsys):
    for line in (TRAIN, SIMULATE, ["export", "latest", "--to", "c"], CHECK):
        trace_cells._library.cache_clear()
        capsys.readouterr()
        assert main(line) == 0, line
        said = capsys.readouterr().err
        assert said.count(SAID) >= 1, line
        assert said.count("warning[W702]") == (line[0] != "export"), line
        toolchain._known.clear()  # the next one is another process
    assert hanging.read_text() == "--version\n"  # asked once, by the first


def test_a_check_alone(hanging, capsys):
    assert main(CHECK) == 0
    assert SAID in capsys.readouterr().err
    assert hanging.read_text() == "--version\n"
