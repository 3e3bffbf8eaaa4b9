"""Words and signs of other tools: accepted, but the language has its own."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar import ast
from stlc.grammar.scan import Lexeme, lexemes
from stlc.grammar.words import BINARY_TEMPORAL, UNARY_TEMPORAL

_SIGNS = {
    **{"&&": "and", "&": "and", "||": "or", "|": "or", "!": "not"},
    **{"=>": "->", "<=>": "<->"},
}
_WORDS = {
    **{word: name for word, name in {**UNARY_TEMPORAL, **BINARY_TEMPORAL}.items() if word != name},
    **{"implies": "->", "iff": "<->"},
}


def foreign_spellings(spec: ast.Spec) -> Iterator[Diagnostic]:
    """W106: `G`, `ev`, `&&`, `=>` and their kin."""
    source = spec.source
    end = Lexeme("sign", "", len(source.text), len(source.text))
    for item, following in pairwise([*lexemes(source.text), end]):
        name = _own(item, following)
        if name is None:
            continue
        span = source.span(item.start, item.end)
        text = f"{name} " if name[-1].isalpha() and _glues(item, following) else name
        if item.start and name[0].isalpha() and source.text[item.start - 1].isalnum():
            text = f" {text}"
        yield Diagnostic(
            "W106",
            f"`{item.text}` is spelled `{name}` here",
            span,
            fix=Fix(((span, text),), f"write `{name}`; `stlc fmt` does"),
        )


def _own(item: Lexeme, following: Lexeme) -> str | None:
    """How the language spells a word or sign of another tool."""
    if item.kind == "sign":
        return _SIGNS.get(item.text)
    if item.kind != "word":
        return None
    bare = item.text.removesuffix("_") if following.text == "[" else item.text
    name = _WORDS.get(bare)
    return bare if name is None and bare != item.text and bare in UNARY_TEMPORAL | BINARY_TEMPORAL else name


def _glues(item: Lexeme, following: Lexeme) -> bool:
    """Whether the word behind a sign would become one with the word that replaces it."""
    return following.start == item.end and following.kind in ("word", "number")
