"""The page about missions: what it shows is what is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.source import Source

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs/missions.md").read_text(encoding="utf-8")


def test_the_specification_on_the_page_is_the_one_that_is_there():
    (shown,) = re.findall(r"^```stlc\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    there = (ROOT / "specs/patrol.stl").read_text(encoding="utf-8")
    assert formulas(shown) == formulas(there)


def formulas(text: str) -> dict[str, ast.Expr]:
    spec = Spec.parse(Source("patrol.stl", text))
    return {item.name: item.formula for item in spec.items if isinstance(item, ast.Require)}


@pytest.mark.parametrize("picture", re.findall(r"\]\((img/[^)]+)\)", TEXT))
def test_pictures_are_small(picture):
    assert 1_000 < (ROOT / "docs" / picture).stat().st_size < 1_000_000
