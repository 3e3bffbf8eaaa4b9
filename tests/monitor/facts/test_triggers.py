"""Obligations that nothing triggered: a worse obligation would have been satisfied as well."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.monitor.judgement import Verdict
from stlc.monitor.verdict import Monitor

HEAD = "signal x\nsignal y\nrequire r: "


def check(text: str, x: np.ndarray, y: np.ndarray) -> Verdict:
    return Monitor(HEAD + text, dt=1.0).check({"x": x, "y": y})


def told(verdict: Verdict, code: str) -> list[str]:
    return [fact.text for fact in verdict.facts if fact.code == code]


SHAPES = {
    "{left} -> {right}": "{left} -> false",
    "always ({left} -> {right})": "always ({left} -> false)",
    "always[1 s, 4 s] ({left} -> {right})": "always[1 s, 4 s] ({left} -> false)",
    "y > -9 and always ({left} -> {right})": "y > -9 and always ({left} -> false)",
    "historically[0 s, 2 s] ({left} -> {right})": "historically[0 s, 2 s] ({left} -> false)",
    "always ({left} -> ({left} -> {right}))": "always ({left} -> false)",
    "false until {left}": "{left}",
    "{left} release {right}": "{left}",
    "always ({right} until {left})": "always {left}",
}
"""Requirement -> what it comes to if nothing triggers it."""


@pytest.mark.parametrize("shape", SHAPES)
@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    left=st.sampled_from(
        ["x > 1", "not x < 0", "once[0 s, 1 s] x > 1.5", "eventually[0 s, 1 s] x > 1", "rise(x > 0)"]
    ),
    right=st.sampled_from(["y > 0", "eventually[0 s, 2 s] y > 0.5"]),
)
def test_never_triggered_means_that_a_worse_requirement_is_satisfied(
    shape: str, seed: int, left: str, right: str
) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=10), rng.normal(size=10)
    verdict = check(shape.format(left=left, right=right), x, y)
    if any(fact.beside for fact in verdict.facts):
        assert verdict.satisfied
        assert check(SHAPES[shape].format(left=left, right=right), x, y).satisfied is not False


X, Y = np.array([0.0, 1.0, 2.0, 1.0]), np.array([1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("always (x > 5 -> y > 9)", ["never triggered (0 of 4)"]),
        ("x > 0 -> y > 9", ["never triggered (0 of 1)"]),
        ("always (x > 1 -> y > 0)", []),
        ("always (x > 5 -> y > 9) and always (x > 1 -> y > 0)", ["`x > 5` never triggered (0 of 4)"]),
        ("always (x > 1 -> (y > 5 -> x < 0))", ["`y > 5` never triggered (0 of 1)"]),
        ("x < 9 until y > 0", ["never triggered (0 of 1)"]),
        ("y > 0 release x < 1", ["never triggered (0 of 1)"]),
        ("x < 9 until x > 1", []),
        ("x < 9 until[1 s, 3 s] y > 0", []),
        ("x < 1 or y > 0", []),
        ("always (x < 5 -> y > 9)", []),  # violated
        ("always (freeze x0 = x in (x > x0 -> y > 9))", []),  # the left side reads a stored value
    ],
)
def test_triggers(text: str, facts: list[str]) -> None:
    assert told(check(text, X, Y), "W712") == facts


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("eventually y > 0", ["`eventually y > 0` true at once, everywhere"]),
        ("always eventually[0 s, 1 s] y > 0", ["`eventually[0 s, 1 s] y > 0` true at once, everywhere"]),
        ("eventually x > 1", []),
        (
            "always (x > 1 -> eventually[1 s, 1 s] x < 2)",
            ["`eventually[1 s, 1 s] x < 2` true at once, everywhere"],
        ),
    ],
)
def test_true_at_once(text: str, facts: list[str]) -> None:
    assert told(check(text, X, Y), "W713") == facts


@pytest.mark.parametrize("text", ["eventually[0 s, 3 s] x > 0", "y > 0 until[0 s, 3 s] x > 0"])
def test_an_unknown_sample_is_not_true_at_once(text: str) -> None:
    verdict = check(text, np.array([np.nan, 1.0, 1.0, 1.0]), Y)
    assert verdict.satisfied
    assert not verdict.facts_on("r")


@pytest.mark.parametrize("text", ["always (y > 0 -> (x > 0 or true))", "always (y > 0 -> (y > 1 -> true))"])
def test_a_signal_that_makes_no_difference_triggers_nothing(text: str) -> None:
    verdict = check(text, X, Y)
    assert verdict.satisfied
    assert not told(verdict, "W712")


def test_traces_are_counted_for_themselves() -> None:
    x = np.stack([X, X - 9.0, X - 9.0])
    assert told(check("always (x > 1 -> y > 0)", x, np.ones_like(x)), "W712") == [
        "`x > 1` never triggered in 2 of 3 traces"
    ]
    (fact,) = [f for f in check("always (x > 5 -> y > 0)", x, np.ones_like(x)).facts if f.code == "W712"]
    assert (fact.text, fact.count, fact.of, fact.beside) == ("never triggered in 3 of 3 traces", 3, 3, True)
