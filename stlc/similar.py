"""Names that are similar to a misspelt one."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher

_SIMILAR = 0.6
_LONGEST = 100
"""Longest name, in characters, for which suggestions are computed (quadratic work)."""


def closest(name: str, candidates: Iterable[str]) -> str | None:
    """Return the candidate that is most similar to a misspelt `name`, or None if none is similar.

    A candidate that differs only in case comes first; then one whose edit distance (with transpositions) is
    at most 1, or at most a third of the number of letters; then the most similar one by Python's difflib.
    """
    pool = sorted({word for word in candidates if 0 < len(word) <= _LONGEST and word != name})
    if len(name) > _LONGEST:
        return None
    folded = name.casefold()
    scored = [(_distance(folded, candidate.casefold()), candidate) for candidate in pool]
    within = [item for item in scored if item[0] <= max(1, len(name) // 3) and item[0] < len(name)]
    if within:
        return min(within, key=lambda item: (item[0], -_ratio(name, item[1]), item[1]))[1]
    best = max(pool, key=lambda candidate: _ratio(folded, candidate.casefold()), default=None)
    return best if best is not None and _ratio(folded, best.casefold()) >= _SIMILAR else None


def did_you_mean(name: str, candidates: Iterable[str], *otherwise: str) -> tuple[str, ...]:
    """Return advice that names the candidate most similar to a misspelt `name`.

    If none is similar, the texts `otherwise` are returned.
    """
    near = closest(name, candidates)
    return otherwise if near is None else (f"did you mean `{near}`?",)


def _ratio(left: str, right: str) -> float:
    return SequenceMatcher(None, left, right).ratio()


def _distance(left: str, right: str) -> int:
    """Edit distance of two words (optimal string alignment): a transposition counts as one edit."""
    before: list[int] = []
    above = list(range(len(right) + 1))
    for i, a in enumerate(left, start=1):
        row = [i]
        for j, b in enumerate(right, start=1):
            cost = min(above[j] + 1, row[j - 1] + 1, above[j - 1] + (a != b))
            if i > 1 and j > 1 and a == right[j - 2] and left[i - 2] == b:
                cost = min(cost, before[j - 2] + 1)
            row.append(cost)
        before, above = above, row
    return above[-1]
