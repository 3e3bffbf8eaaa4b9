from __future__ import annotations

import pytest

from stlc.cli.framework.options import parse_overrides
from stlc.cli.framework.program import describe
from stlc.diagnostics import UsageError


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


def test_examples_stand_after_the_sentence_and_are_not_wrapped():
    text = describe("Do it.", "stlc do", "stlc do --twice", note="Why.")
    assert text == "Do it.\n\n\b\nExamples:\n  stlc do\n  stlc do --twice\n\nWhy."
    assert "\nExample:\n" in describe("Do it.", "stlc do")
