"""Bounds of an online monitor that are not final yet."""

from __future__ import annotations

from stlc.monitor.online.online import Online


def open_starts(online: Online, name: str) -> list[tuple[int, float, float]]:
    """Each start of a requirement that is not final, with its least and greatest robustness."""
    starts = range(online._find(name).tally.next, online.standing(name).next)
    return [(start, *online.bounds(name, start)) for start in starts]
