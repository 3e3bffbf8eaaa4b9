"""Parsers of option values: durations, counts and lists of seeds."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from stlc.diagnostics import Diagnostic, UsageError

if TYPE_CHECKING:
    from stlc.controller.training.budget import Clock

MOST_SEEDS = 1000
_RANGE = re.compile(r"\s*(\d{1,18})\s*(?:\.\.\s*(\d{1,18})\s*)?")


def parse_seconds(text: str) -> float:
    """A duration such as `60s`, `5min`, `1.5 h`, in seconds; a bare number is seconds.

    Raises:
        UsageError: U101, it is not a duration.
    """
    from stlc.units import parse_unit

    number = text.strip().rstrip("abcdefghijklmnopqrstuvwxyz ").strip()
    unit = text.strip()[len(number) :].strip() or "s"
    try:
        value = float(number) * float(parse_unit(unit).scale)
        if parse_unit(unit).dims != parse_unit("s").dims or not 0.0 < value < 1e9:
            raise ValueError
    except ValueError as error:
        finding = Diagnostic(
            "U101", f"`{text}` is not a duration", help=("write it as --budget 60s or 5min",)
        )
        raise UsageError(finding) from error
    return value


def parse_count(text: str, option: str) -> int:
    """A whole number of at least 1. Raises UsageError (U101) for anything else."""
    if re.fullmatch(r"\s*0*[1-9]\d{0,17}\s*", text, re.ASCII):
        return int(text)
    raise UsageError(
        Diagnostic("U101", f"`{option} {text}` is no number from 1 on", help=(f"{option} 1200",))
    )


def parse_limit(text: str) -> float | None:
    """A duration in seconds, or None for `none`. Raises UsageError (U101) for anything else."""
    return None if text.strip() == "none" else parse_seconds(text)


def parse_clock(text: str) -> Clock:
    """Parse the clock of a budget. Raises UsageError (U101) for anything but `wall` and `processor`."""
    match text:
        case "wall" | "processor":
            return text
    raise UsageError(Diagnostic("U101", f"there is no clock `{text}`", help=("wall or processor",)))


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds such as `0..2`, `3`, or `0..2,7`, in that order, without duplicates.

    Raises:
        UsageError: U101, it is not such a list.
    """
    seeds: dict[int, None] = {}
    for part in text.split(","):
        match = _RANGE.fullmatch(part)
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if high < low or high - low >= MOST_SEEDS:
            help_ = ("write it as --seeds 0..2 or 0,3,7",)
            raise UsageError(Diagnostic("U101", f"`{text}` is not a list of seeds", help=help_))
        seeds.update(dict.fromkeys(range(low, high + 1)))
    return tuple(seeds)
