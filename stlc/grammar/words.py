"""Words of the language: temporal operators, reserved words, grammar patterns."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType

from stlc.units import Unit


@dataclass(frozen=True, slots=True)
class TemporalOperator:
    """A temporal operator of the language: its spellings and meaning, for parser, printers and messages.

    Attributes:
        name: preferred spelling.
        meaning: one sentence about the operator, for the editor.
        english: English phrase that contains the operands `{p}` and `{q}` and the window `{when}`.
        aliases: other spellings.
        past: whether the window lies in the past.
        mirror: past operator that corresponds to this future operator, such as `once` to `eventually`; named
            in help texts. "" if there is none.
        expansion: equivalent formula of `p` and `q` that replaces the operator. Its temporal operators get
            the window of the replaced operator. "" if the operator is not replaced.
    """

    name: str
    meaning: str
    english: str
    aliases: tuple[str, ...] = ()
    past: bool = False
    mirror: str = ""
    expansion: str = ""

    @property
    def binary(self) -> bool:
        """True for an operator with two operands, whose English phrase contains `{q}`."""
        return "{q}" in self.english


TEMPORAL = (
    TemporalOperator(
        "always",
        "`always[a, b] p`: p holds at every sample from a to b ahead.",
        "at all times {when}: {p}",
        aliases=("globally", "alw", "G"),
        mirror="historically",
    ),
    TemporalOperator(
        "eventually",
        "`eventually[a, b] p`: p holds at some sample from a to b ahead.",
        "at some time {when}: {p}",
        aliases=("finally", "ev", "F"),
        mirror="once",
    ),
    TemporalOperator(
        "once",
        "`once[a, b] p`: p held at some sample from a to b ago.",
        "at some time {when}: {p}",
        past=True,
    ),
    TemporalOperator(
        "historically",
        "`historically[a, b] p`: p held at every sample from a to b ago.",
        "at all times {when}: {p}",
        aliases=("hist",),
        past=True,
    ),
    TemporalOperator(
        "until",
        "`p until[a, b] q`: q holds at some sample from a to b ahead, and p from now to it.",
        "{p}, until {q}, which happens at some time {when}",
        aliases=("U",),
        mirror="since",
    ),
    TemporalOperator(
        "release",
        "`p release[a, b] q`: q holds from a to b ahead, except once p has held.",
        "{q} at all times {when}, up to and with the time when {p}",
    ),
    TemporalOperator(
        "unless",
        "`p unless[a, b] q`: p holds from now to b ahead, or `p until[a, b] q`.",
        "{p}, until {q}; that need not happen {when}",
    ),
    TemporalOperator(
        "since",
        "`p since[a, b] q`: q held at some sample from a to b ago, and p from there up to now.",
        "{q} at some time {when}, and from then on {p}",
        past=True,
    ),
)

OPERATORS = MappingProxyType({word: each for each in TEMPORAL for word in (each.name, *each.aliases)})
"""Spelling -> temporal operator; one operator has several spellings."""

DECLARATIONS = ("require", "assume", "def", "const", "param", "signal", "region", "enum", "extern", "import")
ROLES = ("input", "output", "state", "env")
PRAGMAS = ("spec", "system", "time")

RESERVED = frozenset(
    {
        *("not", "and", "or", "xor", "iff", "implies", "in", "if", "then", "else", "true", "false", "inf"),
        *("forall", "exists", "freeze"),
        *OPERATORS,
        *DECLARATIONS,
    }
)
"""Reserved words, usable as names only in backticks."""

BUILT_IN = MappingProxyType(
    {"T": "the planning horizon", "end": "the last sample", "dt": "the time between two samples"}
)
"""Built-in names; a user-defined name of this spelling needs backticks."""

SPACE = r"[ \t\r\n]"
"""Pattern of a blank. `stlc.grammar.errors.unicode` refuses every other blank, and CR outside of CRLF."""

_BLANK = rf"(?:{SPACE}|(?:#|\/\/)[^\n]*(?:\n|\Z))"


def _choice(words: Iterable[str]) -> str:
    return "(?:" + "|".join(sorted(map(re.escape, words), key=lambda word: (-len(word), word))) + ")"


def _units() -> str:
    """Pattern of one unit; a table of all of them with their prefixes would make the lexer slow."""
    prefix = _choice(Unit.PREFIXES)
    known = {*Unit.PREFIXED, *(prefix + unit for prefix in Unit.PREFIXES for unit in Unit.PREFIXED)}
    plain = _choice(Unit.SYMBOLS.keys() - known - {"%", "1"})
    return f"(?:{prefix}?{_choice({*Unit.PREFIXED} - {'T'})}|{prefix}T|{plain})"


PATTERNS = MappingProxyType(
    {
        "SPACE": SPACE,
        "BLANK": _BLANK,
        "UNARY": _choice(word for word, each in OPERATORS.items() if not each.binary),
        "BINARY": _choice(word for word, each in OPERATORS.items() if each.binary),
        "RESERVED": _choice(RESERVED),
        "AFTER_PERCENT": _choice(RESERVED - {"true", "false", "inf"}),
        "UNITS": _units(),
        "EXPONENT": r"(?:\^-?\d+(?!\.?\d)|⁻?[¹²³⁴])",
    }
)
"""Replacements of `{{NAME}}` in `stl.lark`."""
