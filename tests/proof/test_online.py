"""Random specifications, sample by sample: a stream against the monitor that sees the whole trace.

`-m slow` runs 10,000 cases; `tools/proofs.py` any number.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
from proof.amounts import FULL, seeds
from proof.streamed import TASTES, check_online, check_promise, check_stream, drawn

FORMER = tuple(replace(taste, bools=False) for taste in TASTES)
"""Of the cases that are known by their seed."""


@pytest.mark.parametrize("numbers", seeds(FULL, 20))
def test_samples_one_by_one(numbers: range) -> None:
    assert sum(map(check_online, numbers)) > len(numbers) / 2


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(600000003709, id="what the past tells beyond the end of a planning window"),
        pytest.param(694993044804, id="what the past tells for ever"),
    ],
)
def test_a_case_that_was_wrong_once(seed: int) -> None:
    found = drawn(seed, FORMER)
    assert found is not None
    check_stream(*found)


@pytest.mark.parametrize("numbers", seeds(FULL, 20))
def test_what_was_said_stays_true(numbers: range) -> None:
    assert sum(map(check_promise, numbers)) > len(numbers) / 2


def test_samples_are_kept_until_their_verdict_is_told() -> None:
    assert check_online(261)  # evaluated anew, at every start
