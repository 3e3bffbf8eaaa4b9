"""The session of the page on Python runs, and prints what the page says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
_BLOCK = re.compile(r"^```(python|text)\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.apart
def test_the_notebook_runs(tmp_path, monkeypatch, capsys):
    pytest.importorskip("torch")
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    for name in ("specs", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    space: dict[str, object] = {}
    for kind, text in _BLOCK.findall((ROOT / "docs/notebook.md").read_text(encoding="utf-8")):
        if kind == "python":
            capsys.readouterr()
            exec(compile(text, "notebook.md", "exec"), space)
        else:
            assert capsys.readouterr().out == text
    assert "_repr_html_" in dir(space["verdict"])
