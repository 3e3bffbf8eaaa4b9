"""phi_safe: the requirements that the backup policy must keep, whatever else fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

SAFETY = "safety"


class Tagged(Protocol):
    """What has tags."""

    @property
    def tags(self) -> frozenset[str]:
        """Bare tag names."""


T = TypeVar("T", bound=Tagged)


def safe_part(rules: Sequence[T]) -> tuple[T, ...]:
    """Those that are tagged `@safety`, in order; phi_safe is their conjunction."""
    return tuple(rule for rule in rules if SAFETY in rule.tags)
