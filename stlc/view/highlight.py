"""Specifications and system files with their words set apart, as HTML."""

from __future__ import annotations

import re

from stlc.grammar.words import PRAGMAS, RESERVED, ROLES
from stlc.view.html import Html, classed, join

_SPEC = re.compile(
    r"(?P<cm>#[^\n]*|//[^\n]*)|(?P<text>\"[^\"\n]*\")|(?P<kw>@\w+|\b(?:"
    + "|".join(sorted((*RESERVED, *PRAGMAS, *ROLES), key=len, reverse=True))
    + r")\b)"
)
_YAML = re.compile(r"(?P<cm>(?:^|(?<=\s))#[^\n]*)|(?P<kw>^[ ]*(?:- )?[\w.-]+(?=:(?:\s|$)))", re.MULTILINE)


def spec_html(text: str) -> Html:
    """A specification's text."""
    return _marked(text, _SPEC)


def yaml_html(text: str) -> Html:
    """A system file's text."""
    return _marked(text, _YAML)


def _marked(text: str, pattern: re.Pattern[str]) -> Html:
    parts: list[Html | str] = []
    last = 0
    for match in pattern.finditer(text):
        parts.append(text[last : match.start()])
        kind = match.lastgroup
        parts.append(classed("span", kind, match[0]) if kind in ("cm", "kw") else match[0])
        last = match.end()
    return join([*parts, text[last:]])
