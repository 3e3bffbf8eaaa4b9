"""The budget: a file is one idea, a function one step of it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILE_LINES = 400
FUNCTION_LINES = 60
SYSTEM_LINES = 150

CODE = sorted(path for folder in ("stlc", "tools", "examples") for path in (ROOT / folder).rglob("*.py"))
NAMES = [str(path.relative_to(ROOT)) for path in CODE]


@pytest.mark.parametrize("path", CODE, ids=NAMES)
def test_a_file_fits(path):
    count = len(path.read_text(encoding="utf-8").splitlines())
    assert count <= FILE_LINES, f"{count} lines"


@pytest.mark.parametrize("path", CODE, ids=NAMES)
def test_a_function_fits(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    long = [
        f"{node.name}: {(node.end_lineno or 0) - node.lineno + 1} lines"
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or 0) - node.lineno + 1 > FUNCTION_LINES
    ]
    assert not long, "; ".join(long)


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.yaml")), ids=lambda path: path.name)
def test_a_system_file_fits(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= SYSTEM_LINES


def test_the_code_was_found():
    assert len(CODE) > 20
