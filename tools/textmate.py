"""The TextMate grammar of the language, for syntax highlighting.

Generated from the same tables as the parser's grammar (`stlc.grammar.words`, `stlc.units`, functions), so
that new words are highlighted without further changes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from stlc.compile.ir.functions import REGIONS, callable_names
from stlc.editor.vocabulary import FUNCTIONS
from stlc.grammar.words import (
    BUILT_IN,
    DECLARATIONS,
    OPERATORS,
    PATTERNS,
    PRAGMAS,
    RESERVED,
    ROLES,
)

_TYPES = ("real", "int", "bool", "formula")
_CONSTANTS = ("true", "false", "inf")
_TEMPORAL = tuple(OPERATORS)
_WORDS = (*sorted(RESERVED - {*DECLARATIONS, *_TEMPORAL, *_CONSTANTS}), "from", "as")
"""Reserved words without a pattern of their own."""
_NAME = r"`[^`\n]+`|[^\W\d]\w*"


def textmate() -> dict[str, Any]:
    """Return the grammar as the JSON content of a `.tmLanguage.json` file."""
    parts = _repository()
    return {
        "name": "Signal Temporal Logic",
        "scopeName": "source.stlc",
        "fileTypes": ["stl", "stlc"],
        "patterns": [{"include": f"#{name}"} for name in parts],
        "repository": parts,
    }


def _repository() -> dict[str, Any]:
    """Return the named groups of patterns; if several patterns match at one position, the first wins."""
    return {
        "comment": {
            "patterns": [_of("comment.line.documentation", r"##(?!#).*$"), _of("comment.line", _COMMENT)]
        },
        "string": _of("string.quoted.double", r'"[^"\n]*"'),
        "declaration": {"patterns": _declarations()},
        "pragma": {"patterns": _pragmas()},
        "tag": _of("storage.modifier.tag", rf"(?<!\w)@{_S}*[A-Za-z_]\w*"),
        "quoted": _of("variable.other", r"`[^`\n]+`"),
        "temporal": _of("keyword.operator.temporal", rf"\b{_any(_TEMPORAL)}_?(?!\w)"),
        "role": _of("storage.modifier.role", rf"\b{_any(ROLES)}(?={_S}+signal\b)"),
        "constant": _of("constant.language", _words(_CONSTANTS)),
        "time": _of("variable.language", _words(BUILT_IN)),
        "keyword": _of("keyword.operator.word", _words(_WORDS)),
        "number": _numbers(),
        "unit": _captures(rf"(\[){_S}*({_unit()}|[%1]){_S}*(\])", {"2": "keyword.other.unit"}),
        "region": _of("support.class.region", rf"{_words(REGIONS)}(?={_S}*\()"),
        "function": _of(
            "support.function", rf"{_words({*callable_names(), *FUNCTIONS} - {*REGIONS})}(?={_S}*\()"
        ),
        "type": _captures(rf"(:|->){_S}*({_any(_TYPES)})\b", {"2": "support.type"}),
        "operator": _of("keyword.operator", r"<->|<=>|->|=>|<=|>=|==|!=|\.\.|&&?|\|\|?|[-+*/%^<>=!~]"),
    }


_S = r"[ \t]"
_COMMENT = r"(?:#|//).*$"


def _declarations() -> list[dict[str, Any]]:
    """Patterns for the keyword and the name of a declaration.

    A name gets a TextMate scope (class for colouring) that depends on the kind of declaration. Requirements
    and assumptions have one scope, definitions, regions and enums a second, and all others, such as signals,
    a third.
    """
    rules = ("require", "assume")
    callables = ("def", "region", "enum")
    rest = [word for word in DECLARATIONS if word not in (*rules, *callables, "extern", "import")]
    kinds = (
        (rules, "entity.name.section"),
        (callables, "entity.name.function"),
        (rest, "variable.other.declaration"),
    )
    named = [
        _captures(rf"\b({_any(words)}){_S}+({_NAME})", {"1": "keyword.declaration", "2": scope})
        for words, scope in kinds
    ]
    extern = _captures(
        rf"\b(extern){_S}+(fn){_S}+({_NAME})",
        {"1": "keyword.declaration", "2": "keyword.declaration", "3": "entity.name.function"},
    )
    return [extern, *named, _of("keyword.declaration", _words(DECLARATIONS))]


def _pragmas() -> list[dict[str, Any]]:
    """Patterns for the lines `spec name`, `system "file"` and `time s`.

    Their first words are keywords only at the start of a line.
    """
    head = rf"^{_S}*({_any(PRAGMAS)}){_S}+"
    return [
        _captures(rf"{head}({_NAME})", {"1": "keyword.control.pragma", "2": "entity.name.type"}),
        _captures(rf"{head}(?=\")", {"1": "keyword.control.pragma"}),
    ]


def _numbers() -> dict[str, Any]:
    """Pattern for a number with its unit; a `%` before an operand is the modulo operator, not a unit."""
    number = r"(?:\d[\d_]*\.(?!\.)\d*|\.\d+|\d[\d_]*)(?:[eE][+-]?\d+)?"
    percent = rf"%(?!{_S}*(?!{PATTERNS['AFTER_PERCENT']}\b)[\w(.`])"
    return _captures(
        rf"(?<![\w.])({number})(?:{_S}*(steps?\b|{percent}|{_unit()}(?!\w)))?",
        {"1": "constant.numeric", "2": "keyword.other.unit"},
    )


def _unit() -> str:
    """Regular expression for a unit: a product of powers without blanks, such as `m/s^2`."""
    one = f"(?:{PATTERNS['UNITS']}|[%1](?=/)){PATTERNS['EXPONENT']}?"
    return rf"{one}(?:[*/·]{PATTERNS['UNITS']}{PATTERNS['EXPONENT']}?)*"


def _any(words: Iterable[str]) -> str:
    return "(?:" + "|".join(sorted(map(re.escape, set(words)), key=lambda word: (-len(word), word))) + ")"


def _words(words: Iterable[str]) -> str:
    return rf"\b{_any(words)}\b"


def _of(scope: str, pattern: str) -> dict[str, Any]:
    return {"name": f"{scope}.stlc", "match": pattern}


def _captures(pattern: str, scopes: dict[str, str]) -> dict[str, Any]:
    return {
        "match": pattern,
        "captures": {group: {"name": f"{scope}.stlc"} for group, scope in scopes.items()},
    }
