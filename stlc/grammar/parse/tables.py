"""The Lark parser of `stl.lark`, once per process, its tables kept between processes.

Building the LALR tables takes a tenth of a second, reading them back a fifth of that. They are kept as JSON
(never a pickle) in the cache folder (`stlc.cache`), under a name that changes with the grammar, with Lark and
with Python. A cache that is missing, damaged or not writable costs that time and nothing else.
"""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from hashlib import sha256
from importlib.resources import files
from typing import Any

import lark
from lark import UnexpectedInput
from lark.grammar import Rule
from lark.lexer import TerminalDef

from stlc.cache import lasting
from stlc.grammar.words import PATTERNS

_DAMAGED = (ValueError, TypeError, LookupError, AttributeError, AssertionError, lark.exceptions.LarkError)


@cache
def load_parser() -> lark.Lark:
    """The parser of the language, with the start rules `start` and `expr`."""
    grammar = grammar_text()
    kept, name = lasting(), cache_name(grammar)
    parser = None if kept is None else _read(kept.read(name))
    if parser is None:
        parser = build_parser(grammar)
        if kept is not None:
            kept.keep(name, _dumped(parser).encode())
    return parser


def grammar_text() -> str:
    """The grammar with the words of the language in it."""
    text = (files("stlc.grammar") / "stl.lark").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: PATTERNS[match[1]], text)


def build_parser(grammar: str) -> lark.Lark:
    """A parser from scratch."""
    return lark.Lark(
        grammar,
        parser="lalr",
        lexer="contextual",
        start=["start", "expr"],
        maybe_placeholders=True,
        propagate_positions=True,
    )


def cache_name(grammar: str) -> str:
    """Under which name the tables of this grammar are kept."""
    key = f"{lark.__version__} {sys.version_info[:2]} {grammar}"
    return f"grammar-{sha256(key.encode()).hexdigest()[:16]}.json"


def _dumped(parser: lark.Lark) -> str:
    data, memo = parser.memo_serialize([TerminalDef, Rule])
    return json.dumps([data, memo], separators=(",", ":"))


def _read(text: bytes | None) -> lark.Lark | None:
    if text is None:
        return None
    try:
        data, memo = json.loads(text, object_hook=_with_numbers)
        parser: lark.Lark = lark.Lark._load_from_dict(data, memo)  # type: ignore[no-untyped-call]
    except _DAMAGED:
        return None
    return parser


def _with_numbers(value: dict[str, Any]) -> dict[str | int, Any]:
    """The tables are keyed by numbers, which JSON writes as texts."""
    return {int(key) if key.isdigit() else key: item for key, item in value.items()}


def acceptable(text: str, rule: str = "start") -> frozenset[str] | None:
    """The terminals that may follow `text`, or None where `text` itself cannot be read.

    Args:
        text: the beginning of a declaration, or of an expression.
        rule: the start rule, `start` or `expr`.
    """
    interactive = load_parser().parse_interactive(text, start=rule)
    try:
        for _ in interactive.iter_parse():
            pass
        accepted: set[str] = interactive.accepts()  # type: ignore[no-untyped-call]
    except UnexpectedInput:
        return None
    return frozenset(accepted)
