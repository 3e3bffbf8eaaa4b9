"""The tutorials work: their files are written, their commands are run in order, their output is compared."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.walkthrough import labels, steps, walk

DOCS = Path(__file__).resolve().parent.parent / "docs"
ANY = (0, 1, 4)
"""Exit codes that a hardly trained policy may give."""


def test_the_files_were_found():
    found = steps(DOCS / "tutorial.md")
    assert [step.name for step in found if step.name] == ["tank.stl", "tank.csv", "tank.yaml", "pump.stl"]
    assert len([step for step in found if step.kind == "command"]) > 10
    assert labels("worst   room 0.1\nfails in most\n  a b_1  c  d\nstep 5  0.1") == ["worst", "a b_1"]


@pytest.mark.apart
def test_a_tank_is_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    says_no = {"stlc check tank.stl": (1,), "stlc explain tank.csv": (1,), "stlc check trace.npz": ANY}
    walk(DOCS / "tutorial.md", says_no, capsys)
    assert (tmp_path / "tank.svg").is_file()
    assert list(tmp_path.glob("runs/pump/*/report.html"))


@pytest.mark.slow
def test_a_quadrotor_flies_through_two_windows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    found = steps(DOCS / "own-system.md")
    assert [step.name for step in found if step.name] == ["systems/quad.yaml", "specs/windows.stl"]
    assert {step.kind for step in found} == {"file", "command", "python", "shown"}
    walk(DOCS / "own-system.md", {"stlc check trace.npz": ANY, "stlc explain trace.npz": ANY}, capsys)
    assert Path("map.png").is_file()
    assert Path("signals.svg").is_file()
    assert len(list(Path("runs/windows").glob("0001-*/report.html"))) == 1


@pytest.mark.parametrize("wrong", ["no file", "$ stlc lint tank.stl\n1 file, everything to say"])
def test_what_a_page_says_wrongly_is_seen(wrong, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    if wrong == "no file":
        text = text.replace("<!-- file: tank.stl -->\n", "")
    else:
        text = text.replace("$ stlc lint tank.stl\n1 file, nothing to say", wrong)
    (tmp_path / "page.md").write_text(text, encoding="utf-8")
    with pytest.raises(AssertionError, match="stlc lint"):
        walk(tmp_path / "page.md", {}, capsys)
