from __future__ import annotations

import json
import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.jsontext import data_of, dumps, plain


def strict(text: str) -> Any:
    """Parse as a strict reader does: no NaN, no Infinity."""

    def refuse(token: str) -> None:
        raise AssertionError(f"{token} is not JSON")

    return json.loads(text, parse_constant=refuse)


data = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(data)
def test_data_come_back_as_they_were(value):
    assert strict(dumps(value)) == value


@pytest.mark.parametrize(
    ("number", "text"), [(float("inf"), "inf"), (float("-inf"), "-inf"), (float("nan"), "nan")]
)
def test_numbers_that_are_not_finite_are_texts(number, text):
    assert plain(number) == text
    assert plain(np.array([1.0, number])) == [1.0, text]
    assert strict(dumps({"a": [number]})) == {"a": [text]}


@dataclass(frozen=True, slots=True)
class Point:
    x: float
    where: Path


def test_what_holds_data_is_taken_apart():
    assert plain(Point(0.5, Path("a/b"))) == {"x": 0.5, "where": "a/b"}
    assert plain({1: (Fraction(1, 4), np.float32(0.5), np.int64(3), np.bool_(True))}) == {
        "1": [0.25, 0.5, 3, True]
    }
    assert plain(frozenset({7})) == [7]


def test_what_is_no_data_is_refused():
    with pytest.raises(TypeError, match="object is no JSON data"):
        plain([object()])


# ---------------------------------------------------------------------- stored data


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a": 1, "z": 1e999}', "`z` is not finite, or is too large"),
        ('{"a": 1, "z": NaN}', "`z` is not finite"),
        ('{"a": 1, "z": -1e101}', "`z` is not finite, or is too large"),
        (f'{{"a": 1{"0" * 150}}}', "`a` is not finite, or is too large"),
        (f'{{"a": 1, "z": {"[" * 101}{"]" * 101}}}', "is nested more than 100 deep"),
    ],
)
def test_stored_data_that_no_reader_accepts_name_the_key(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        data_of(text)


def test_stored_data() -> None:
    text = '{"a": 1, "b": null, "c": {"k": "t", "d": []}, "e": [1, 2.5], "f": "10 s", "other": [{}]}'
    assert data_of(text) == data_of(text.encode()) == json.loads(text)
    with pytest.raises(ValueError, match="utf-8"):
        data_of(b"\xff")
    with pytest.raises((ValueError, RecursionError)):
        data_of("[" * 100_000)


@given(data)
def test_whatever_is_written_is_read_or_is_too_large(value: Any) -> None:
    try:
        assert data_of(dumps(value)) == json.loads(dumps(value))
    except ValueError as error:
        assert "too large" in str(error)  # noqa: PT017
