"""Recognisers of texts of other tools: definitions of Breach, and numbers over a window."""

from __future__ import annotations

import re

from stlc.diagnostics import Diagnostic
from stlc.grammar.errors.failure import ParseFailure
from stlc.grammar.scan import brackets
from stlc.grammar.words import OPERATORS

_OPERATOR = re.compile(rf"\b({'|'.join(sorted(OPERATORS, key=len, reverse=True))})_?\s*(?=\[)")
_BOUNDS = re.compile(r"\[\s*([\d.]+)\s*,\s*([\d.]+)\s*\]")
_INDEXED = re.compile(r"\b(\w+)\[t\]")
_SINGLE = re.compile(r"\(([^()&|]*)\)$")
_OVER_WINDOW = {
    **dict.fromkeys(("count", "num", "number", "atleast", "atmost", "cardinality"), "a count"),
    **dict.fromkeys(("mean", "avg", "average", "sum", "integral", "std", "var", "median", "rms"), "a mean"),
}
_ADVICE = {
    "a count": "three times within 5 s, with 5 s from each to the next:  "
    "eventually[0 s, 5 s] (p and eventually(0 s, 5 s] (p and eventually(0 s, 5 s] p))",
    "a mean": "a mean of a few samples:  `(x + shift(x, -1) + shift(x, -2)) / 3`; "
    "extremes:  `max[-5 s, 0 s](x)`, `min[…]`",
}


def number_over_window(failure: ParseFailure) -> Diagnostic | None:
    """Return the finding for `count[0 s, 5 s](p)` or `mean[0 s, 5 s](x)`; else None."""
    for bracket in brackets(failure.before):
        index = failure.before.index(bracket.opening)
        word = failure.before[index - 1] if index else None
        if bracket.opening.text != "[" or bracket.closing is not None or word is None:
            continue
        kind = _OVER_WINDOW.get(word.text.lower())
        if kind is not None and failure.found is not None and failure.found.text in (",", ":"):
            message = f"the language has no `{word.text}` over a window"
            more = "or count it in a column of the recording, or in a state of the system"
            return Diagnostic("E016", message, failure.of(word), help=(_ADVICE[kind], more))
    return None


def definition_of_breach(failure: ParseFailure) -> Diagnostic | None:
    """Return the finding for a definition of Breach, `phi := alw_[0, 5] (x[t] > 0)`; else None."""
    name, sign = (*failure.after, None, None)[:2]
    if name is None or sign is None or name.kind != "word" or "_REQUIRE" not in failure.accepts:
        return None
    source = failure.piece.source
    if not source.text.startswith(":=", sign.start):
        return None
    line = source.text[sign.start + 2 :].partition("\n")[0].partition("#")[0].strip()
    line = _OPERATOR.sub(lambda match: OPERATORS[match[1]].name, line)
    line = _BOUNDS.sub(r"[\1 s, \2 s]", _INDEXED.sub(r"\1", line))
    line = _SINGLE.sub(r"\1", line)
    return Diagnostic(
        "E010",
        "`:=` defines a formula in Breach, not here",
        failure.of(name),
        help=(f"require {name.text}: {line}", f"or, for a part of others:  def {name.text} = {line}"),
        note=("a signal's name is its value now: `x`, not `x[t]`; times have units",),
    )
