"""Advice about units that the language does not have."""

from __future__ import annotations

from stlc.grammar.words import UNIT_NAMES
from stlc.similar import closest
from stlc.units import Unit

_PREFIXES = "pnumkMG"
_USUAL = tuple(
    prefix + unit for prefix in ("", *_PREFIXES) for unit in Unit.PREFIXED if prefix + unit in Unit.SYMBOLS
)
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
    named = UNIT_NAMES.get(word.lower())
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
