from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from stlc.editor.document import Document, Systems, analyse
from stlc.source import Source

sys.path.insert(0, str(Path(__file__).parent))

ROOT = Path(__file__).resolve().parent.parent.parent
TRAFFIC = ROOT / "specs/traffic.stl"


@pytest.fixture
def traffic() -> Document:
    return analyse(Source(str(TRAFFIC), TRAFFIC.read_text(encoding="utf-8")), Systems())


@pytest.fixture
def write() -> Callable[[str], tuple[Document, int]]:
    """A text with a cursor, `│`, as a document and an offset."""

    def look(text: str) -> tuple[Document, int]:
        offset = max(text.find("│"), 0)
        return analyse(Source("untitled:1", text.replace("│", "")), Systems()), offset

    return look
