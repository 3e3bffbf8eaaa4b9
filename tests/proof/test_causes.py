"""Causes of random violated requirements, of recordings and streams; `tools/proofs.py` tries any number."""

from __future__ import annotations

import itertools

import pytest
from proof import blamed

CHECKS = {"recorded": blamed.check_cause, "streamed": blamed.check_told_by_stream}


@pytest.mark.parametrize("name", CHECKS)
def test_the_cause_is_what_it_is_said_to_be(name: str) -> None:
    assert sum(CHECKS[name](seed) for seed in range(100, 130)) > 10


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("recorded", 10_000), ("streamed", 2_500)])
def test_many_causes(name: str, least: int) -> None:
    seeds, violated = itertools.count(1000), 0
    while violated < least:
        violated += CHECKS[name](next(seeds))


@pytest.mark.parametrize("name", CHECKS)
@pytest.mark.parametrize(
    "seed", [4008, 5350, 7000075, 9101148, 9101178, 9101732, 9200317, 9202142, 9202282, 9201672]
)
def test_what_was_wrong_once(name: str, seed: int) -> None:
    assert CHECKS[name](seed)
