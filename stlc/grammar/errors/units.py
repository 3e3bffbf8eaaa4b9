"""Advice about units that the language does not have."""

from __future__ import annotations

from types import MappingProxyType

from stlc.similar import closest
from stlc.units import Unit

_PREFIXES = "pnumkMG"
_USUAL = tuple(
    prefix + unit for prefix in ("", *_PREFIXES) for unit in Unit.PREFIXED if prefix + unit in Unit.SYMBOLS
)
_NAMES = MappingProxyType(
    {
        **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
        **dict.fromkeys(("second", "seconds", "sec", "secs"), "s"),
        **dict.fromkeys(("minute", "minutes", "mins"), "min"),
        **dict.fromkeys(("hour", "hours", "hr", "hrs"), "h"),
        **dict.fromkeys(("degree", "degrees"), "deg"),
        **dict.fromkeys(("radian", "radians"), "rad"),
        **dict.fromkeys(("kilogram", "kilograms", "kgs"), "kg"),
        **dict.fromkeys(("kmh", "kph"), "km/h"),
        **{"hertz": "Hz", "newton": "N", "volt": "V", "watt": "W", "percent": "%", "sample": "steps"},
    }
)
"""Unit written out -> its symbol in the language."""
_UNPREFIXED = ("min", "h", "ft", "mph", "lb", "rpm", "deg", "degC", "kg")


def unit_advice(word: str) -> tuple[str, ...]:
    """Return the advice about an unknown unit `word`: the units that may be meant; () if there are none.

    A prefix is kept, since `mNm` is no advice for a misspelt `MNm`. Units that differ in case only are named
    with their sizes.
    """
    if word == "T":
        return ("`T` is the planning horizon; a tesla is `Wb/m^2`, a millitesla `mT`",)
    if len(word) < 2 or word in Unit.SYMBOLS or Unit.celsius_advice(word):
        return ()
    named = _NAMES.get(word.lower())
    alike = [named] if named else [unit for unit in _USUAL if unit.casefold() == word.casefold()]
    for prefix in "" if alike else _PREFIXES:
        rest = word.removeprefix(prefix)
        units = [unit for unit in Unit.PREFIXED if rest != word and unit[0].casefold() == rest[:1].casefold()]
        near = closest(rest, units)
        alike += [] if near is None or near == "T" else [prefix + near]
    near = None if alike else closest(word, [*Unit.PREFIXED, *_UNPREFIXED])
    alike = alike[:3] if near is None else [near]
    if len(alike) < 2:
        return tuple(f"did you mean `{unit}`?" for unit in alike)
    sizes = (f"`{unit}` ({Unit.SYMBOLS[unit].scale:g} {Unit.SYMBOLS[unit].si})" for unit in alike)
    return (f"did you mean {' or '.join(sizes)}?",)
