"""Formulas that other tools read differently: parentheses make them one (see `stlc.grammar.ambiguity`)."""

from __future__ import annotations

from collections.abc import Iterator

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar import ast
from stlc.grammar.ambiguity import Ambiguity, Kind, ambiguities

_WHY: dict[Kind, str] = {
    "scope": "here a temporal word ends before `{outer}`; RTAMT, MoonLight and FalCAuN take in what follows",
    "mixed": "`and` binds tighter here; `or` does in RTAMT and MoonLight, and STLRom has one rank for both",
    "chain": "`->` goes from the right here; RTAMT and MoonLight read it from the left",
    "until": "`until` and its kin bind tighter than `{outer}` here; RTAMT and MoonLight bind them looser",
    "implication": "`->` binds loosest here; MoonLight binds it tightest, STLRom has one rank for all",
}


def missing_parentheses(spec: ast.Spec) -> Iterator[Diagnostic]:
    """W301: a part whose extent depends on the tool."""
    return (_finding("W301", part) for part in ambiguities(spec))


def unclear_implications(spec: ast.Spec) -> Iterator[Diagnostic]:
    """W302: `and` or `or` beside `->`, which most readers and tools read as it is meant here."""
    parts = ambiguities(spec, implications=True)
    return (_finding("W302", part) for part in parts if part.kind == "implication")


def _finding(code: str, part: Ambiguity) -> Diagnostic:
    start, end = part.span.start, part.span.end
    source = part.span.source
    edits = ((source.span(start, start), "("), (source.span(end, end), ")"))
    text = " ".join(part.span.text.split())
    shown = f"({text})" if "#" not in text and "//" not in text else "(…)"
    return Diagnostic(
        code,
        "other tools read this differently without parentheses",
        part.span,
        note=(_WHY[part.kind].format(outer=part.outer),),
        fix=Fix(edits, f"write `{shown}`; `stlc fmt` does"),
    )
