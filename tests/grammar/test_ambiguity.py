"""Formulas that other tools read differently."""

from __future__ import annotations

import pytest

from stlc.grammar.ambiguity import ambiguities
from stlc.grammar.spec import Spec
from stlc.source import Source


def parts(text: str, *, implications: bool = False) -> list[tuple[str, str]]:
    spec = Spec.parse(Source("text", f"require r: {text}"))
    return [(part.span.text, part.kind) for part in ambiguities(spec, implications=implications)]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("always[0, T] a and b", [("always[0, T] a", "scope")]),
        ("a and always b or c", [("a and always b", "mixed")]),
        ("a and not always b and c", [("not always b", "scope")]),
        ("(a and always b) or c", []),
        ("always (a and b)", []),
        ("a and always b", []),
        ("a -> always b", []),
        ("always a -> b", [("always a", "scope")]),
        ("a -> b -> c", [("b -> c", "chain")]),
        ("(a -> b) -> c", []),
        ("a -> (b -> c)", []),
        ("a or b and c", [("b and c", "mixed")]),
        ("a or b xor c", [("a or b", "mixed")]),
        ("a and b until c", [("b until c", "until")]),
        ("a until b -> c", [("a until b", "until")]),
        ("always a until b", [("always a", "scope")]),
        ("(always a) until b", []),
        ("forall i in 0..2: once x[i] > 0 and a", [("forall i in 0..2: once x[i] > 0", "scope")]),
        ("not a and b", []),
        ("a and b and c", []),
        ("a and b -> c", []),
    ],
)
def test_what_is_unclear(text, found):
    assert parts(text) == found


def test_implications_are_told_where_they_are_asked_for():
    assert parts("a and b -> c or d", implications=True) == [
        ("a and b", "implication"),
        ("c or d", "implication"),
    ]
