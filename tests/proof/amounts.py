"""Numbers of cases of the tests of this folder."""

from __future__ import annotations

import os
import random
from typing import Any

import pytest

FULL = 10_000
BLOCK = 500
FAST = 30
"""Cases of each kind before a change lands: the first third in the ordinary suite, the others apart."""

FIRST = random.SystemRandom().randrange(1 << 40) if os.environ.get("STLC_EXPLORE") else 0
"""The first seed: always the same, or drawn freshly where hypothesis explores too."""


def seeds(count: int, fast: int = FAST) -> list[Any]:
    """The first ones in the ordinary suite and apart, blocks of all of them behind the marker `slow`."""
    last, third = FIRST + count, FIRST + (fast + 2) // 3
    slow = [range(low, min(low + BLOCK, last)) for low in range(FIRST, last, BLOCK)]
    return [
        pytest.param(range(FIRST, third), id="some"),
        pytest.param(range(third, FIRST + fast), id="more", marks=pytest.mark.apart),
        *(pytest.param(part, id=f"{part.start}", marks=pytest.mark.slow) for part in slow),
    ]
