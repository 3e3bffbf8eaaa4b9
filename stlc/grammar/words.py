"""Vocabulary of the language: reserved words, aliases, and names of tokens in messages."""

from __future__ import annotations

import re
from collections.abc import Iterable
from types import MappingProxyType

from stlc.units import SYMBOLS

UNARY_TEMPORAL = MappingProxyType(
    {
        "always": "always",
        "globally": "always",
        "alw": "always",
        "G": "always",
        "eventually": "eventually",
        "finally": "eventually",
        "ev": "eventually",
        "F": "eventually",
        "once": "once",
        "historically": "historically",
        "hist": "historically",
    }
)
"""Spelling of a temporal operator with one operand -> its name."""

BINARY_TEMPORAL = MappingProxyType(
    {"until": "until", "U": "until", "release": "release", "unless": "unless", "since": "since"}
)
"""Spelling of a temporal operator with two operands -> its name."""

DECLARATIONS = ("require", "assume", "def", "const", "param", "signal", "region", "enum", "extern", "import")
ROLES = ("input", "output", "state", "env")
PRAGMAS = ("spec", "system", "time")

RESERVED = frozenset(
    {
        *("not", "and", "or", "xor", "iff", "implies", "in", "if", "then", "else", "true", "false", "inf"),
        *("forall", "exists", "freeze"),
        *UNARY_TEMPORAL,
        *BINARY_TEMPORAL,
        *DECLARATIONS,
    }
)
"""Reserved words, usable as names only in backticks."""

BUILT_IN = MappingProxyType(
    {"T": "the planning horizon", "end": "the last sample", "dt": "the time between two samples"}
)
"""Built-in names; a user-defined name of this spelling needs backticks."""

UNIT_NAMES = MappingProxyType(
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

_BLANK = r"(?:\s|(?:#|\/\/)[^\n]*(?:\n|\Z))"


def _choice(words: Iterable[str]) -> str:
    return "(?:" + "|".join(sorted(map(re.escape, words), key=lambda word: (-len(word), word))) + ")"


PATTERNS = MappingProxyType(
    {
        "BLANK": _BLANK,
        "UNARY": _choice(UNARY_TEMPORAL),
        "BINARY": _choice(BINARY_TEMPORAL),
        "RESERVED": _choice(RESERVED),
        "AFTER_PERCENT": _choice(RESERVED - {"true", "false", "inf"}),
        "UNITS": _choice(SYMBOLS.keys() - {"%", "1"}),
        "EXPONENT": r"(?:\^-?\d+(?!\.?\d)|⁻?[¹²³⁴])",
    }
)
"""Replacements of `{{NAME}}` in `stl.lark`."""
