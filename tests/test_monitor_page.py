"""The page about the monitor is one session: every line of it is typed, and answers what the page shows."""

from __future__ import annotations

import doctest
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs/monitor.md").read_text(encoding="utf-8")


def test_the_session(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    blocks = re.sub(r"^(?!```pycon).*?(?=^```pycon|\Z)", "", TEXT, count=1, flags=re.MULTILINE | re.DOTALL)
    session = "\n".join(re.findall(r"^```pycon\n(.*?)^```", blocks, re.MULTILINE | re.DOTALL))
    test = doctest.DocTestParser().get_doctest(session, {}, "docs/monitor.md", None, 0)
    assert len(test.examples) > 40
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test)
    assert not result.failed, capsys.readouterr().out
