"""Effort of a piece of work in calls: the same number on every machine, however loaded it is."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any


def effort(work: Callable[[], object]) -> int:
    """Number of functions, of Python and of C, that `work` calls; its exceptions are not caught."""
    count = 0

    def counted(_frame: FrameType, event: str, _what: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(counted)
    try:
        work()
    finally:
        sys.setprofile(before)
    return count


def refused(work: Callable[[], object], error: type[BaseException]) -> tuple[Any, int]:
    """Exception of `work`, and the effort until then."""
    caught: list[BaseException] = []

    def attempt() -> None:
        try:
            work()
        except error as found:
            caught.append(found)

    spent = effort(attempt)
    assert caught, "nothing was raised"
    return caught[0], spent
