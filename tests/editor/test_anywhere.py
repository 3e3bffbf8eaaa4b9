"""Whatever is typed and wherever the cursor is, every question has an answer."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.editor.completion import complete
from stlc.editor.document import Systems, analyse, definition, outline
from stlc.editor.hover import hover
from stlc.editor.rename import RenameError, rename
from stlc.source import Source

DATA = sorted((Path(__file__).parent.parent / "grammar/data").glob("*.stl"))
TEXTS = {path.stem: path.read_text(encoding="utf-8") for path in DATA}
SYSTEMS = Systems()


def ask_everything(text: str, offset: int) -> None:
    document = analyse(Source("untitled:1", text), SYSTEMS)
    for finding in document.findings:
        assert 0 <= finding.span.start <= finding.span.end <= len(text)
    found = hover(document, offset)
    assert found is None or found[0].start <= offset <= found[0].end
    offered = complete(document, offset)
    assert offered.start <= offset
    assert len({offer.text for offer in offered.offers}) == len(offered.offers)
    definition(document, offset)
    outline(document)
    with suppress(RenameError):
        assert rename(document, offset, "another_name")


@pytest.mark.apart
@pytest.mark.parametrize("name", TEXTS)
def test_in_every_line_of_a_finished_text(name):
    text = TEXTS[name]
    for offset in range(0, len(text), 293):
        ask_everything(text, offset)


@pytest.mark.parametrize("name", TEXTS)
def test_while_a_text_is_typed(name):
    text = TEXTS[name]
    for length in range(0, len(text), 197):
        ask_everything(text[:length], length)


@settings(max_examples=12)
@given(st.sampled_from(sorted(TEXTS)), st.data())
def test_in_a_damaged_text(name, data):
    text = TEXTS[name]
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(len(text), start + 40)))
    junk = data.draw(st.text(alphabet='abT09 \n()[]{}@"`#<>=-.,:;□😀', max_size=8))
    damaged = text[:start] + junk + text[end:]
    ask_everything(damaged, min(start + len(junk), len(damaged)))
