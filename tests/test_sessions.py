"""Pages that show Python sessions: every line of them is typed, and answers what the page shows."""

from __future__ import annotations

import doctest
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize(("page", "least"), [("monitor", 40), ("semantics", 10), ("api", 10)])
def test_the_session_of_a_page(page, least, monkeypatch, capsys):
    if page == "api":
        pytest.importorskip("torch")
    monkeypatch.chdir(ROOT)
    name = f"docs/{page}.md"
    text = (ROOT / name).read_text(encoding="utf-8")
    session = "\n".join(re.findall(r"^```pycon\n(.*?)^```", text, re.MULTILINE | re.DOTALL))
    test = doctest.DocTestParser().get_doctest(session, {}, name, None, 0)
    assert len(test.examples) >= least
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test)
    assert not result.failed, capsys.readouterr().out
