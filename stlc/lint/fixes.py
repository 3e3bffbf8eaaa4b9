"""Edits that repair what was found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from stlc.diagnostics import Diagnostic, Fix
from stlc.source import Source

ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Fixed:
    """A repaired text.

    Attributes:
        source: the text as it is now.
        findings: what is left.
        count: how many findings were repaired.
    """

    source: Source
    findings: tuple[Diagnostic, ...]
    count: int


def fix(source: Source, look: Callable[[Source], Sequence[Diagnostic]]) -> Fixed:
    """Repair a text until nothing is left that can be repaired.

    A round that would bring new errors is not taken. Repairs that overlap wait for the next round.

    Args:
        source: the text.
        look: a text -> its findings.
    """
    findings, count = tuple(look(source)), 0
    for _ in range(ROUNDS):
        chosen = _apart([finding.fix for finding in findings if _fits(finding.fix, source)])
        if not chosen:
            break
        repaired = Source(source.name, _edited(source.text, chosen))
        after = tuple(look(repaired))
        if repaired.text == source.text or _errors(after) > _errors(findings):
            break
        source, findings, count = repaired, after, count + len(chosen)
    return Fixed(source, findings, count)


def _fits(repair: Fix | None, source: Source) -> bool:
    return repair is not None and all(span.source is source for span, _ in repair.edits)


def _errors(findings: Iterable[Diagnostic]) -> int:
    return sum(finding.severity == "error" for finding in findings)


def _apart(repairs: Iterable[Fix | None]) -> list[Fix]:
    """Repairs that do not touch the same part of the text; of two the first."""
    chosen: list[Fix] = []
    taken: set[tuple[int, int]] = set()
    for repair in repairs:
        if repair is None or not repair.edits:
            continue
        places = {(span.start, span.end) for span, _ in repair.edits}
        if not any(_touch(place, other) for place in places for other in taken):
            chosen.append(repair)
            taken |= places
    return chosen


def _touch(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


def _edited(text: str, repairs: Iterable[Fix]) -> str:
    edits = [(span.start, span.end, new) for repair in repairs for span, new in repair.edits]
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text
