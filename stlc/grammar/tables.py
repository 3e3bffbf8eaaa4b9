"""Parser of the language, made by Lark from `stl.lark` once per process; its tables are cached on disk.

Building the parsing tables (LALR) takes a tenth of a second; reading stored tables takes a fifth of that
time. They are stored as JSON (never a pickle) in the cache folder (`stlc.cache`), under a name that depends
on the grammar and on the versions of Lark and Python. If the cache is missing, damaged or read-only, the
tables are built anew.
"""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import lark
from lark import UnexpectedInput
from lark.grammar import Rule
from lark.lexer import TerminalDef

from stlc.cache import persistent
from stlc.grammar.words import PATTERNS

_DAMAGED = (ValueError, TypeError, LookupError, AttributeError, AssertionError, lark.exceptions.LarkError)


@cache
def load_parser() -> lark.Lark:
    """Return the parser of the language, with the start rules `start` and `expr`."""
    grammar = grammar_text()
    store, name = persistent(), cache_name(grammar)
    parser = None if store is None else _read(store.read(name))
    if parser is None:
        parser = build_parser(grammar)
        if store is not None:
            parts = parser.memo_serialize([TerminalDef, Rule])
            store.write(name, json.dumps(parts, separators=(",", ":")).encode())
    return parser


def grammar_text() -> str:
    """Return the text of `stl.lark` with the words of the language inserted."""
    text = Path(__file__).with_name("stl.lark").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: PATTERNS[match[1]], text)


def build_parser(grammar: str) -> lark.Lark:
    """Return a new parser of a grammar, without using the cache."""
    return lark.Lark(
        grammar,
        parser="lalr",
        lexer="contextual",
        start=["start", "expr"],
        maybe_placeholders=True,
        propagate_positions=True,
    )


def cache_name(grammar: str) -> str:
    """Return the file name of a grammar's cached tables, for the installed versions of Lark and Python."""
    key = f"{lark.__version__} {sys.version_info[:2]} {grammar}"
    return f"grammar-{sha256(key.encode()).hexdigest()[:16]}.json"


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
    """Return a JSON object with keys of digits as integers, which JSON stores as strings."""
    return {int(key) if key.isdigit() else key: item for key, item in value.items()}


def acceptable(text: str, rule: str = "start", *, even_broken: bool = False) -> frozenset[str] | None:
    """Return the names of the grammar's terminals that may follow `text`; None if `text` has a syntax error.

    Args:
        text: the beginning of a declaration, or of an expression.
        rule: start rule of the grammar, `start` or `expr`.
        even_broken: if `text` has an error, return the terminals accepted there instead of None.
    """
    interactive = load_parser().parse_interactive(text, start=rule)
    try:
        for _ in interactive.iter_parse():
            pass
    except UnexpectedInput:
        if not even_broken:
            return None
    terminals: set[str] = interactive.accepts()  # type: ignore[no-untyped-call]
    return frozenset(terminals)


def parses(text: str, rule: str) -> bool:
    """True if the whole text matches the start rule `rule` of the grammar."""
    try:
        load_parser().parse(text, start=rule)
    except UnexpectedInput:
        return False
    return True
