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
SYSTEMS = sorted((ROOT / "examples").glob("*.yaml"))


@pytest.mark.parametrize(("paths", "limit"), [(CODE, FILE_LINES), (SYSTEMS, SYSTEM_LINES)])
def test_files_fit(paths, limit):
    lines = {str(path.relative_to(ROOT)): len(path.read_bytes().splitlines()) for path in paths}
    assert {name: count for name, count in lines.items() if count > limit} == {}


def test_the_code_was_found():
    assert len(CODE) > 20
