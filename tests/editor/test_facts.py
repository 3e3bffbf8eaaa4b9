"""Facts of a recording in an editor."""

from __future__ import annotations

from pathlib import Path

from stlc.diagnostics import FACTS
from stlc.editor.document import Systems, analyse
from stlc.editor.server import make_server
from stlc.source import Source


def test_a_document_with_a_recording_shows_its_facts(tmp_path: Path) -> None:
    path = tmp_path / "l.csv"
    path.write_text("t,x\n" + "".join(f"{i},{i % 3}\n" for i in range(20)))
    document = analyse(Source("s.stl", "signal x\nrequire r: x < 3\n"), Systems(), path)
    (one,) = [one for one in document.findings if one.diagnostic.code in FACTS]
    assert (one.diagnostic.code, one.span.line) == ("W711", 2)
    assert one.diagnostic.message == "`r`: judged at 0 s only, of 19 s"
    assert make_server(path).trace == path


def test_a_text_with_errors_is_not_judged(tmp_path: Path) -> None:
    source = Source("s.stl", "signal x\nrequire r: y < 3\n")
    found = analyse(source, Systems(), tmp_path / "none.csv").findings
    assert [one.diagnostic.code for one in found] == ["E101"]
