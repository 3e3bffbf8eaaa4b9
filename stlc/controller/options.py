"""Bounds of the numeric options of training methods and planners, declared where the options are."""

from __future__ import annotations

from dataclasses import Field, dataclass, field
from typing import Any

MOST = 1e12
"""Magnitude from which a bound is none."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Least and greatest value of an option, both allowed."""

    least: float
    most: float

    def __contains__(self, value: float) -> bool:
        return self.least <= value <= self.most

    def __str__(self) -> str:
        if self.most >= MOST:
            return f"at least {self.least:,.12g}" if self.least > -MOST else "that is finite"
        return f"from {self.least:,.12g} to {self.most:,.12g}"


FINITE = Bounds(-MOST, MOST)
"""Bounds of the options of planners that declare none."""


def bounded(default: float, least: float, most: float) -> Any:
    """Field of a dataclass of options: a number from `least` to `most`."""
    return field(default=default, metadata={"bounds": Bounds(least, most)})


def bounds_of(option: Field[Any], undeclared: Bounds) -> Bounds:
    """Bounds of an option as `bounded` declares them, else `undeclared`."""
    found: Bounds = option.metadata.get("bounds", undeclared)
    return found
