"""Bounds of the numeric options of training methods and planners, declared where the options are."""

from __future__ import annotations

from dataclasses import Field, field
from typing import Any

MOST = 1e12
"""Upper bound of an option without declared bounds; the lower one is 0."""


def bounded(default: float, least: float, most: float) -> Any:
    """Field of a dataclass of options: a number from `least` to `most`."""
    return field(default=default, metadata={"bounds": (least, most)})


def bounds_of(option: Field[Any]) -> tuple[float, float]:
    """Least and greatest value of an option: those of `bounded`, else 0 and `MOST`."""
    found: tuple[float, float] = option.metadata.get("bounds", (0.0, MOST))
    return found


def allowed(least: float, most: float) -> str:
    """Allowed values as text, such as `from 1 to 4,096`."""
    return f"at least {least:,.12g}" if most >= MOST else f"from {least:,.12g} to {most:,.12g}"
