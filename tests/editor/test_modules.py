"""Names behind a dot: `std.response`, and those of files."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.editor.completion import complete
from stlc.editor.document import Document, Systems, analyse, definition
from stlc.editor.hover import hover
from stlc.source import Source

LIMITS = "const top [m] = 3\n## near enough\ndef near(d) = d < top\nsignal z\nrequire r: z > 0\n"


@pytest.fixture
def typed(tmp_path):
    (tmp_path / "limits.stl").write_text(LIMITS, encoding="utf-8")

    def look(text: str) -> tuple[Document, int]:
        head = 'import std\nimport "limits.stl" as m\nsignal x [m]\nsignal go : bool\n'
        offset = len(head) + text.index("│")
        path = tmp_path / "main.stl"
        return analyse(Source(str(path), head + text.replace("│", "")), Systems()), offset

    return look


def test_no_findings(typed):
    document, _ = typed("require r: always (m.near(x) and std.response(go, x > m.top, 2 s))│")
    assert [one.diagnostic.code for one in document.findings] == []


def test_hover(typed):
    found = hover(*typed("require r: m.ne│ar(x)"))
    assert found is not None
    assert found[0].text == "near"
    assert "def near(d) = d < top" in found[1]
    assert "near enough" in found[1]
    assert "from `limits.stl`" in found[1]
    assert "library std" in hover(*typed("require r: std.stays│(go, 1 s)"))[1]


def test_definition_in_the_other_file(typed, tmp_path):
    (span,) = definition(*typed("require r: x > m.top│"))
    assert Path(span.source.name) == tmp_path / "limits.stl"
    assert span.line == 1
    (span,) = definition(*typed("require r: std.│response(go, go, 1 s)"))
    assert span.source.name.endswith("std.stl")
    assert span.text == "response"


def test_completion_behind_a_dot(typed):
    assert [offer.text for offer in complete(*typed("require r: m.│")).offers] == ["near", "top", "z"]
    found = complete(*typed("require r: std.res│"))
    assert "response" in [offer.text for offer in found.offers]


def test_a_name_that_the_file_does_not_have(typed):
    document, offset = typed("require r: x > m.botto│m")
    assert definition(document, offset) == ()
    assert "E101" in {one.diagnostic.code for one in document.findings}


def test_a_file_that_is_not_there(tmp_path):
    text = 'import "nothing.stl" as m\nsignal x\nrequire r: x > m.top'
    document = analyse(Source(str(tmp_path / "main.stl"), text), Systems())
    assert document.modules == ()
    assert "E106" in {one.diagnostic.code for one in document.findings}
    assert hover(document, text.index("x >")) is not None
