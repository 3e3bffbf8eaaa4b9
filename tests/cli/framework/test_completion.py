"""Completion in a shell: runs and requirements, from the words on the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc.cli.framework.app import main
from stlc.rundir import RunDir
from stlc.signature import Column, Signature
from stlc.trace import Trace, TraceMeta

SPEC = """signal x [m]
# require old: x > 0
@safety require near: x < 1
require far: x > -1
require `end`: x > 0
"""


@pytest.fixture(autouse=True)
def _project(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("s.stl").write_text(SPEC)
    meta = TraceMeta(spec_text="signal x\nrequire kept: x > 0\n")
    Trace(Signature((Column("x"),)), 0.1, {"x": np.ones((1, 2))}, meta=meta).save("t.npz")
    for words in ("quiet-heron", "brisk-otter"):
        RunDir.create(Path("runs"), "cart", words).update({"status": "finished"})
    RunDir.create(Path("elsewhere"), "boat", "old-crow").update({"status": "finished"})


def completed(monkeypatch, capsys, line: str) -> list[str]:
    monkeypatch.setenv("_STLC_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    main([])
    return capsys.readouterr().out.split()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("stlc check s.stl a.csv --require ", ["near", "far", "end"]),
        ("stlc check a.csv s.stl --require n", ["near"]),
        ("stlc check t.npz --require ", ["kept"]),
        ("stlc explain s.stl --require f", ["far"]),
        ("stlc plot a.csv --spec s.stl --require ne", ["near"]),
        ("stlc check none.csv --require ", []),
        ("stlc runs show 0002", ["0002-brisk-otter"]),
        ("stlc runs rm l", ["latest"]),
        ("stlc simulate ", ["latest", "0002-brisk-otter", "0001-quiet-heron", "cart"]),
        ("stlc report --runs elsewhere 0", ["0001-old-crow"]),
        ("stlc train --resume c", ["cart"]),
        ("stlc sim", ["simulate"]),
    ],
)
def test_a_line_is_completed(line, words, monkeypatch, capsys):
    assert completed(monkeypatch, capsys, line) == words
