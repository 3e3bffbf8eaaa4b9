"""The budget: a file is one idea, whole; branching in a function is limited by the linter (complexity 10)."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILE_LINES = 800
SYSTEM_LINES = 150

CODE = sorted(
    path for folder in ("stlc", "benchmarks", "tools", "examples") for path in (ROOT / folder).rglob("*.py")
)
NAMES = [str(path.relative_to(ROOT)) for path in CODE]


@pytest.mark.parametrize("path", CODE, ids=NAMES)
def test_a_file_fits(path):
    count = len(path.read_text(encoding="utf-8").splitlines())
    assert count <= FILE_LINES, f"{count} lines"


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.yaml")), ids=lambda path: path.name)
def test_a_system_file_fits(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= SYSTEM_LINES


def test_the_code_was_found():
    assert len(CODE) > 20
