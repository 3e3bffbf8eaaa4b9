"""Signature of a state tensor or a trace: its ordered, named columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from stlc.units import DIMENSIONLESS, Unit

Kind = Literal["real", "int", "bool", "enum"]
Role = Literal["input", "output", "state", "env", "timer"]


@dataclass(frozen=True, slots=True)
class Column:
    """A scalar column.

    Attributes:
        name: as written in specifications and system files.
        unit: physical unit of the numbers that are stored.
        kind: what the numbers mean; bool is 0/1, enum one of `labels`.
        role: of the column; `timer` columns are appended by the compiler.
        low: nominal lower end of its range, in its unit (None: unknown).
        high: nominal upper end.
        labels: (label, value) pairs of an enum.
        fact: the range is enforced (clamp, bool, enum), not only nominal.
    """

    name: str
    unit: Unit = DIMENSIONLESS
    kind: Kind = "real"
    role: Role = "state"
    low: float | None = None
    high: float | None = None
    labels: tuple[tuple[str, float], ...] = ()
    fact: bool = False


@dataclass(frozen=True, slots=True)
class Signature:
    """Ordered columns. Timers that the compiler adds stand last."""

    columns: tuple[Column, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Column names in order."""
        return tuple(column.name for column in self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __contains__(self, name: object) -> bool:
        return any(column.name == name for column in self.columns)

    def __getitem__(self, name: str) -> Column:
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(name)

    def index(self, name: str) -> int:
        """Position of column `name`. Raises ValueError if there is none."""
        return self.names.index(name)

    def extended(self, *columns: Column) -> Signature:
        """Signature with `columns` appended."""
        return Signature((*self.columns, *columns))
