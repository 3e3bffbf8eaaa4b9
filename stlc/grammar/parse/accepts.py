"""What may stand at a place of a text: the terminals that the parser would take next."""

from __future__ import annotations

from lark import UnexpectedInput

from stlc.grammar.parse.tables import load_parser


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
