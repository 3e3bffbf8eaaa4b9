"""Requirements read aloud."""

from __future__ import annotations

import pytest

from stlc.grammar import ast
from stlc.grammar.english import REPEATED, Meanings, sentence
from stlc.grammar.spec import Spec
from stlc.source import Source


def told(formula: str) -> str:
    (item,) = Spec.parse(Source("text", f"require r: {formula}")).items
    assert isinstance(item, ast.Require)
    return sentence(item)


@pytest.mark.parametrize(
    ("formula", "english"),
    [
        ("always[0, T] x > 1 m", "At all times in the next T: x > 1 m."),
        ("eventually[1 s, 2 s] x > 1 m", "At some time between 1 s and 2 s from now: x > 1 m."),
        ("once[0 s, 3 s] p", "At some time in the last 3 s: p holds."),
        ("historically p", "At all times so far: p holds."),
        (
            "always@[5 s, 9 s) a",
            "At all times between 5 s and 9 s of the mission (the end excluded): a holds.",
        ),
        ("always[2 s, inf] p", "At all times from 2 s from now on: p holds."),
        ("a -> not b", "If a holds, then it is not so that b holds."),
        ("p until[0, T] q", "p holds, until q holds, which happens at some time in the next T."),
        ("p since[0, 2 s] q", "q holds at some time in the last 2 s, and from then on p holds."),
        ("sign == stop and x in [0, 2]", "sign is stop and x is between 0 and 2."),
        ("p not in pond", "p is not in pond."),
        ("x in {1, 2}", "x is one of {1, 2}."),
        ("forall i in 0..6: q[i] > 0", "For every i in 0 to 6: q[i] > 0."),
        ("always (rise(p) -> q)", "At all times from now on: (if p becomes true, then q holds)."),
        ("a xor b", "Either a holds or b holds, not both."),
        ("if a then b else c", "If a holds, then b holds, otherwise c holds."),
        ("freeze x0 = x in always x >= x0", "Let x0 be x as it is now: at all times from now on: x >= x0."),
    ],
)
def test_a_sentence(formula, english):
    assert told(formula) == english


def test_definitions_are_followed():
    spec = Spec.parse(
        Source(
            "text", "const c [m] = 2\nconst d = 3 s\ndef a = b > 1\ndef b = x + c\nrequire r: always[0, d] a"
        )
    )
    item = spec.items[-1]
    assert isinstance(item, ast.Require)
    assert Meanings(spec).of(item) == [("d", "3 s"), ("a", "b > 1"), ("b", "x + c"), ("c", "2 [m]")]


def test_an_implication_is_said_once():
    text = told(" -> ".join(["x > 0"] * 100))
    assert len(text) < 3000


def test_definitions_that_many_requirements_share_are_not_told_with_each():
    count = 1200
    chain = "".join(f"def d{i} = not d{i - 1}\n" for i in range(1, count))
    uses = "".join(f"require r{i}: d{count - 1}\n" for i in range(count))
    spec = Spec.parse(Source("text", f"signal x\ndef d0 = x > 0\n{chain}{uses}"))
    meanings = Meanings(spec)
    told = [meanings.of(item) for item in spec.items if isinstance(item, ast.Require)]
    assert len(told[0]) == count
    assert told[0] == told[1]
    assert not told[-1]
    assert sum(len(text) for each in told for _, text in each) < 2 * REPEATED


@pytest.mark.parametrize(
    ("formula", "english"),
    [
        ("x > 2", "At the first sample: x > 2."),
        ("historically x < 3", "At the first sample: at all times so far: x < 3."),
        ("calm", "At the first sample: calm holds."),
        ("soon", "soon holds."),
        ("always x > 2", "At all times from now on: x > 2."),
        ("x > 2 -> eventually[0 s, 1 s] x > 3", "If x > 2, then at some time in the next 1 s: x > 3."),
        ("std.settles(x, 1, 2, 1 s)", "std.settles(x, 1, 2, 1 s)."),
        ("round", "At the first sample: round holds."),
    ],
)
def test_what_is_read_once(formula, english):
    head = "import std\nsignal x\ndef calm = x < 3\ndef soon = eventually calm\ndef round = round\n"
    spec = Spec.parse(Source("t", f"{head}require r: {formula}"))
    assert Meanings(spec).sentence(spec.items[-1]) == english
