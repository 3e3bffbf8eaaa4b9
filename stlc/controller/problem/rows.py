"""Records of arrays with one entry per plan, agent or state, from which entries are selected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, Self


class Rows:
    """Base of dataclasses whose fields are arrays; their first dimensions are the same."""

    @property
    def parts(self) -> tuple[Any, ...]:
        """The arrays, in the order of the fields."""
        return tuple(getattr(self, each.name) for each in fields(self))  # type: ignore[arg-type]

    def each(self, change: Callable[[Any], Any]) -> Self:
        """Return the record whose arrays are those of this one, changed by a function."""
        return type(self)(*map(change, self.parts))

    def of(self, rows: Any) -> Self:
        """Return the entries with indices `rows`, (k,), or those that a mask selects."""
        return self.each(lambda part: part[rows])

    def to(self, device: Any) -> Self:
        """Return the record with its tensors on a torch device."""
        return self.each(lambda part: part.to(device))

    def put(self, rows: Any, other: Self) -> None:
        """Replace the entries with indices `rows`, (k,), by those of another record, (k, …)."""
        for mine, theirs in zip(self.parts, other.parts, strict=True):
            mine[rows] = theirs
