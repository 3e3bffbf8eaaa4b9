"""The lint of files as a function: what it finds, repairs and leaves out."""

from __future__ import annotations

from pathlib import Path

import pytest

import stlc

UNCLEAR = "signal x [m]\nrequire low: always[0 s, 1 s] x < 3 m and x > 0 m\n"


def test_findings_are_counted_and_those_of_other_codes_left_out(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / f"{name}.stl").write_text(UNCLEAR)
    found = stlc.lint(tmp_path)
    assert len(found.files) == 2
    assert {each.code for each in found.findings} == {"W301", "W311"}
    assert repr(found) == f"Lint({found.count} warnings in 2 files)"
    assert not found.invalid
    assert not stlc.lint(tmp_path, ignore=["W3"]).findings
    (tmp_path / "one.stl").write_text("require a: x >")
    assert stlc.lint(tmp_path / "one.stl").invalid


def test_a_file_is_repaired_in_place(tmp_path: Path) -> None:
    path = tmp_path / "unclear.stl"
    path.write_text(UNCLEAR)
    found = stlc.lint([path], fix=True)
    assert found.fixed == 1
    assert path.read_text() != UNCLEAR
    assert [each.code for each in found.findings] == ["W311"]


def test_there_is_no_such_code() -> None:
    with pytest.raises(stlc.StlcError, match="U101"):
        stlc.lint("specs/traffic.stl", select=["W99"])
