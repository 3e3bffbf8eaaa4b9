from __future__ import annotations

import json
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.jsontext import dumps, plain


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
