"""Instants in emitted C: known when the text is written, or following from the loops of `freeze` around."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Index:
    """An instant.

    Attributes:
        text: C expression.
        low: the least value it takes.
        high: the greatest.
    """

    text: str
    low: int
    high: int

    def plus(self, steps: int) -> Index:
        """So many samples later."""
        if self.low == self.high:
            return at(self.low + steps)
        return Index(f"({self.text} + {steps})", self.low + steps, self.high + steps) if steps else self

    def at_least(self, least: int) -> Index:
        """The later one of it and `least`."""
        if self.low >= least:
            return self
        return at(least) if self.high <= least else Index(f"LATER({self.text}, {least})", least, self.high)


def at(instant: int) -> Index:
    """An instant that is known."""
    return Index(str(instant), instant, instant)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive instants, both ends included; none where `last` is before `first`."""

    first: Index
    last: Index

    @property
    def rows(self) -> int:
        """How many instants lie between the earliest first and the latest last one."""
        return self.last.high - self.first.low + 1

    @property
    def single(self) -> bool:
        """Whether it is one instant, wherever."""
        return self.first == self.last

    @property
    def settled(self) -> Stretch:
        """All instants that it covers in any turn of the loops around."""
        return Stretch(at(self.first.low), at(self.last.high))

    def loop(self, *, back: bool = False) -> str:
        """The head of a loop over its instants `k`."""
        if back:
            return f"for (int k = {self.last.text}; k >= {self.first.text}; --k)"
        return f"for (int k = {self.first.text}; k <= {self.last.text}; ++k)"


def between(first: int, last: int) -> Stretch:
    """Instants that are known."""
    return Stretch(at(first), at(last))
