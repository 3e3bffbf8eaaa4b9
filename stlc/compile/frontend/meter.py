"""How large an expression may grow while macros expand and quantifiers unroll."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

MAX_NODES = 50_000
MAX_LEVELS = 120


@dataclass(slots=True)
class Cost:
    """Size and depth of an expression, written out in full."""

    nodes: int = 0
    levels: int = 0


@dataclass(slots=True)
class Meter:
    """Counts nodes as if every definition were written out, although each is evaluated once.

    Attributes:
        nodes: so far.
        level: of nesting right now.
        deepest: largest level so far.
        reported: the excess of the declaration at hand has been reported.
    """

    nodes: int = 0
    level: int = 0
    deepest: int = 0
    reported: bool = False

    @property
    def over(self) -> bool:
        """Whether a limit is passed."""
        return self.nodes > MAX_NODES or self.deepest > MAX_LEVELS

    def enter(self) -> None:
        """One node deeper."""
        self.nodes += 1
        self.level += 1
        self.deepest = max(self.deepest, self.level)

    def leave(self) -> None:
        """Back to the node around it."""
        self.level -= 1

    def charge(self, cost: Cost) -> None:
        """Count something that was evaluated before as if it were written here."""
        self.nodes += cost.nodes
        self.deepest = max(self.deepest, self.level + cost.levels)

    @contextmanager
    def measured(self) -> Iterator[Cost]:
        """Yields a `Cost` that tells, after the block, what was evaluated inside without being charged."""
        nodes, deepest, level = self.nodes, self.deepest, self.level
        self.nodes, self.deepest = 0, level
        cost = Cost()
        try:
            yield cost
        finally:
            cost.nodes, cost.levels = self.nodes, self.deepest - level
            self.nodes, self.deepest, self.level = nodes, deepest, level

    @contextmanager
    def fresh(self) -> Iterator[None]:
        """A budget of its own: a declaration is not charged for its neighbours."""
        saved = self.nodes, self.level, self.deepest
        self.nodes, self.level, self.deepest, self.reported = 0, 0, 0, False
        try:
            yield
        finally:
            self.nodes, self.level, self.deepest = saved
