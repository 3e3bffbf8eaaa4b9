"""Signature of a state tensor or a trace: its named scalar signals (columns), in order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from stlc.jsontext import Num
from stlc.units import Unit

Kind = Literal["real", "int", "bool", "enum"]
Role = Literal["input", "output", "state", "env", "timer"]


@dataclass(frozen=True, slots=True)
class Column:
    """Description of a scalar signal, one column of a state tensor or trace.

    Attributes:
        name: name in specifications and system files.
        unit: physical unit of the stored numbers.
        kind: type of the signal; a bool is stored as 0 or 1, an enum as a value of `labels`.
        role: role of the signal, such as state or parameter; the compiler appends columns with the role
            `timer`.
        low: lower end of the range, in `unit`; None if unknown.
        high: upper end of the range, in `unit`; None if unknown.
        labels: (label, value) pairs of an enum.
        fact: True if all values lie within the range: a clamp enforces it, or the signal is a bool or enum.
            False if the range is only nominal.
    """

    name: str
    unit: Unit = Unit.ONE
    kind: Kind = "real"
    role: Role = "state"
    low: Num | None = None
    high: Num | None = None
    labels: tuple[tuple[str, float], ...] = ()
    fact: bool = False

    MAX_COMPONENTS: ClassVar = 4096
    """Most components of a vector."""
    TRUTH: ClassVar = dict.fromkeys(("true", "yes", "on"), 1.0) | dict.fromkeys(("false", "no", "off"), 0.0)
    """Words for truth values, in any case."""

    @property
    def words(self) -> Mapping[str, float]:
        """Words for its values: the labels of an enum, or those for truth values; else none."""
        return self.TRUTH if self.kind == "bool" else dict(self.labels)


@dataclass(frozen=True, slots=True)
class Signature:
    """Ordered columns of a state tensor or trace; the timers that the compiler adds come last."""

    columns: tuple[Column, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Column names in order."""
        return tuple(column.name for column in self.columns)

    @property
    def nominal(self) -> dict[str, tuple[float, float]]:
        """Declared range of each column that has one, enforced or not, in the unit of the column."""
        return {
            column.name: (column.low, column.high)
            for column in self.columns
            if column.low is not None and column.high is not None
        }

    @property
    def enforced(self) -> dict[str, tuple[float, float]]:
        """Ranges that columns never leave, each in the unit of its column.

        Bools and enums have such a range, and so does a column whose range is marked as enforced
        (`Column.fact`).
        """
        facts: dict[str, tuple[float, float]] = {}
        for column in self.columns:
            if column.kind == "bool":
                facts[column.name] = (0.0, 1.0)
            elif column.labels:
                values = [value for _, value in column.labels]
                facts[column.name] = (min(values), max(values))
            elif column.fact and column.low is not None and column.high is not None:
                facts[column.name] = (column.low, column.high)
        return facts

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
        """Position of the column `name`. Raises ValueError if there is none."""
        return self.names.index(name)

    def extended(self, *columns: Column) -> Signature:
        """Return a signature with `columns` appended at the end."""
        return Signature((*self.columns, *columns))
