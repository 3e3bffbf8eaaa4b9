"""Bounds of the numeric options of training methods and planners, declared where the options are."""

from __future__ import annotations

from dataclasses import Field, dataclass, field
from typing import Any

from stlc.diagnostics import usage

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


_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


def value_of(owner: str, option: Field[Any], value: object) -> Any:
    """Convert the value of an option from text to the type of its default.

    Args:
        owner: method or planner that has the option, for the message.
        option: the option.
        value: text, or a value of the type.

    Raises:
        UsageError: U101, the text is not of this type, or the number is out of its bounds.
    """
    kind: Any = type(option.default)
    kinds = (int, float) if kind is float else (kind,)
    message = f"option `{option.name}` of {owner} is"
    wanted = {bool: "`true` or `false`", int: "a whole number", str: "a text"}.get(kind, "a number")
    if isinstance(value, str) and kind is not str:
        try:
            value = _WORDS[value] if kind is bool else kind(value)
        except (ValueError, KeyError):
            raise usage(f"{message} {wanted}, not `{value}`") from None
    if not isinstance(value, kinds) or (kind is not bool and isinstance(value, bool)):
        raise usage(f"{message} {wanted}, not `{value}`")
    if kind in (int, float) and value not in (bounds := bounds_of(option, FINITE)):
        raise usage(f"{message} {wanted} {bounds}, not `{value}`")
    return value
