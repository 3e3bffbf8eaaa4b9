from __future__ import annotations

from pathlib import Path

import pytest

from stlc.cli.framework.options import require_separate
from stlc.cli.framework.program import describe
from stlc.diagnostics import UsageError
from stlc.options import parse_overrides


def test_overrides():
    assert parse_overrides(None) == {}
    assert parse_overrides(["T_red=3 s", "train.lr = 3e-4", "note=a=b"]) == {
        "T_red": "3 s",
        "train.lr": "3e-4",
        "note": "a=b",
    }


@pytest.mark.parametrize("pair", ["T_red", "=3", "T_red=", ""])
def test_what_is_no_override(pair):
    with pytest.raises(UsageError, match="NAME=VALUE"):
        parse_overrides([pair])


def test_a_name_is_given_once():
    with pytest.raises(UsageError, match="given twice"):
        parse_overrides(["a=1", "a=2"])


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ({"--out": "a.csv"}, "`--out a.csv` is a file that this command reads"),
        ({"--out": "b/../a.csv"}, "a file that this command reads"),
        ({"--out": "link.csv"}, "a file that this command reads"),
        ({"--out": "new.csv", "--table": "./new.csv"}, "`--table ./new.csv` is also the file of `--out`"),
        ({"--out": "c.csv", "--table": "/dev/null", "--junit": "/dev/null"}, None),
        ({"--out": None, "--table": "-", "--junit": "b", "--record": "a.csv/x", "--robustness": "\0"}, None),
    ],
)
def test_a_file_is_not_read_and_written(written, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.csv").touch()
    Path("b").mkdir()
    Path("link.csv").symlink_to("a.csv")
    read = ("a.csv", "-", None, "b", "none.csv", Path("new.stl"))
    if said is None:
        return require_separate(written.items(), read)
    with pytest.raises(UsageError) as caught:
        require_separate(written.items(), read)
    assert said in caught.value.diagnostics[0].message
    assert caught.value.diagnostics[0].code == "U101"
    return None


def test_examples_stand_after_the_sentence_and_are_not_wrapped():
    text = describe("Do it.", "stlc do", "stlc do --twice", note="Why.")
    assert text == "Do it.\n\n\b\nExamples:\n  stlc do\n  stlc do --twice\n\nWhy."
    assert "\nExample:\n" in describe("Do it.", "stlc do")
