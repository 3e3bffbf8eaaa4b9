"""Tags of signals: their values between recorded samples."""

from __future__ import annotations

import math

import pytest

import stlc
from stlc.diagnostics import SpecError
from stlc.monitor.signals import reading_of
from stlc.trace import Reading
from stlc.trace.resample import Between


def test_tags_state_the_values_between_samples() -> None:
    declared = (
        "@hold signal a",
        "@hold(500 ms) signal b",
        "@linear signal c",
        "@angle signal d [deg]",
        "signal e",
    )
    text = "\n".join((*declared, "require r: a > 0"))
    between = reading_of(stlc.parse(text)).between
    assert between == {
        "a": Between("hold"),
        "b": Between("hold", 0.5),
        "c": Between("linear"),
        "d": Between("angle", period=pytest.approx(360.0)),
    }
    asked = reading_of(stlc.parse(text), Reading(between={"a": Between("linear"), "e": Between("angle")}))
    assert (asked.between["a"].how, asked.between["e"].period) == ("linear", 2 * math.pi)


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ("@hold(2 m)", "does not take this argument"),
        ("@hold(0 s)", "does not take this argument"),
        ("@linear(1 s)", "does not take this argument"),
        ("@hold @angle", "one value between its samples"),
        ("@safety", "says nothing about a `signal`"),
    ],
)
def test_wrong_tags(tags: str, words: str) -> None:
    with pytest.raises(SpecError, match=rf"E501.*{words}"):
        stlc.Monitor(f"{tags} signal a\nrequire r: a > 0")
