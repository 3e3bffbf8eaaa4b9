"""Diagnostics of syntax errors: a table of recognisers of common mistakes.

A recogniser is a function. It maps a `ParseFailure` to a finding, or to None if it does not recognise the
mistake. The first finding is used. `expected.py` handles the errors that no recogniser matches.
"""

from __future__ import annotations

from collections.abc import Callable

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar.errors.expected import (
    expected,
    misspelt_operator,
    point,
    stray_bracket,
    unknown_declaration,
    unknown_unit,
    wrong_name,
)
from stlc.grammar.errors.failure import ParseFailure, Piece
from stlc.grammar.errors.foreign import definition_of_breach, number_over_window
from stlc.grammar.errors.unicode import apart, named, replacement, unexpected_character
from stlc.grammar.scan import Bracket, Lexeme, brackets, opens_interval
from stlc.grammar.words import OPERATORS

Recogniser = Callable[[ParseFailure], Diagnostic | None]

_TAKES_LEFT = frozenset({"in", "not", "<", "<=", ">", ">=", "==", "!=", "*", "/", "%", "^"})


def diagnose(piece: Piece, at: int) -> Diagnostic:
    """Return the diagnostic of a part of a text (`piece`) whose parsing failed at offset `at`."""
    failure = ParseFailure(piece, at)
    for recognise in RECOGNISERS:
        finding = recognise(failure)
        if finding is not None:
            return finding
    return expected(failure)


# ---------------------------------------------------------------- E001: characters


def _unclosed_text(failure: ParseFailure) -> Diagnostic | None:
    found = failure.found
    if found is None or found.text not in ('"', "`"):
        return None
    what = "text" if found.text == '"' else "name"
    return Diagnostic(
        "E011", f"this `{found.text}` is never closed", point(failure, found), f"a {what} ends on its line"
    )


def _character(failure: ParseFailure) -> Diagnostic | None:
    found = failure.found
    if found is None or not unexpected_character(found):
        return None
    char = found.text[0]
    span = failure.piece.source.span(found.start, found.start + 1)
    message = f"unexpected character {named(char)}"
    advice = replacement(char)
    if advice is None or advice.text is None:
        return Diagnostic("E001", message, span, help=() if advice is None else (advice.help,))
    edits = _all_replacements(failure, found)
    fix = Fix(tuple((failure.piece.source.span(low, high), text) for low, high, text in edits))
    return Diagnostic("E001", message, span, help=(f"{advice.help}:  {failure.line_with(*edits)}",), fix=fix)


def _all_replacements(failure: ParseFailure, found: Lexeme) -> list[tuple[int, int, str]]:
    """Return the edits that replace all foreign characters, such as `≤`, in the line of `found`."""
    source = failure.piece.source
    line = source.position(found.start)[0]
    edits: list[tuple[int, int, str]] = []
    for lexeme in failure.lexemes:
        advice = replacement(lexeme.text[0]) if unexpected_character(lexeme) else None
        if advice is None or advice.text is None or source.position(lexeme.start)[0] != line:
            continue
        edits.append((lexeme.start, lexeme.start + 1, apart(advice.text, source.text, lexeme.start)))
    return edits


# ------------------------------------------------------------------- E002: bars


def _bars(failure: ParseFailure) -> Diagnostic | None:
    found = failure.found
    if found is None or found.text not in ("|", "||") or not failure.wants_operand:
        return None
    closing = next((lexeme for lexeme in failure.after[1:] if lexeme.text == found.text), None)
    if closing is None:
        return None
    span = failure.of(found, closing)
    function = "abs" if found.text == "|" else "norm"
    inner = failure.piece.source.text[found.end : closing.start].strip()
    what = "absolute value" if function == "abs" else "a norm"
    return Diagnostic(
        "E002",
        f"`{found.text}` is `or` here; there is no {found.text}…{found.text} for {what}",
        span,
        help=(f"write `{function}({inner})`",),
        fix=Fix(((span, f"{function}({inner})"),)),
    )


# ------------------------------------------------------------------ E011: brackets


def _unclosed(failure: ParseFailure) -> Diagnostic | None:
    if failure.found is not None or not failure.open_brackets:
        return None
    opening = failure.open_brackets[-1].opening
    next_ = failure.follower
    labels = () if next_ is None else (failure.of(next_).label("the next declaration starts here"),)
    note: tuple[str, ...] = ()
    for inner in brackets(failure.before):
        same = inner.opening.text == opening.text and inner.opening.start > opening.start
        if same and inner.closing is not None and not note:
            line, column = failure.piece.source.position(inner.opening.start)
            note = (f"the inner `{opening.text}` on line {line}, column {column} is closed",)
    message = f"this `{opening.text}` is never closed"
    return Diagnostic("E011", message, failure.of(opening), "opened here", labels, note=note)


# ----------------------------------------------------------- E012: chains of until


def _chain(failure: ParseFailure) -> Diagnostic | None:
    found = failure.found
    if found is None or not _is_binary(found) or "AND" not in failure.accepts:
        return None
    second = len(failure.before)
    first = _until_before(failure, second)
    if first is None:
        return None
    text = failure.piece.source.text
    start = failure.lexemes[failure.operand_before(first)].start
    middle = failure.lexemes[_behind_interval(failure, first)].start
    last = failure.operand_after(_behind_interval(failure, second)) - 1
    left, head = text[start:middle].rstrip(), text[start : failure.lexemes[second - 1].end]
    right = text[middle : failure.lexemes[last].end]
    tail = text[found.start : failure.lexemes[last].end]
    return Diagnostic(
        "E012",
        f"`{_operator(found)}` does not chain; say which one is inside",
        failure.of(found),
        labels=(failure.of(failure.lexemes[first]).label(f"first `{_operator(failure.lexemes[first])}`"),),
        help=(f"{left} ({right})     or     ({head}) {tail}",),
    )


def _operator(lexeme: Lexeme) -> str:
    return lexeme.text.rstrip("_") if lexeme.kind == "word" else lexeme.text


def _is_binary(lexeme: Lexeme) -> bool:
    operator = OPERATORS.get(_operator(lexeme))
    return operator is not None and operator.binary


def _until_before(failure: ParseFailure, index: int) -> int | None:
    depth = 0
    for i in range(index - 1, -1, -1):
        text = failure.lexemes[i].text
        depth += (text in (")", "]", "}")) - (text in ("(", "[", "{"))
        if depth < 0:
            return None
        if depth == 0 and _is_binary(failure.lexemes[i]):
            return i
    return None


def _behind_interval(failure: ParseFailure, index: int) -> int:
    """Return the index of the first lexeme after a temporal operator and its interval.

    `index` is the index of the operator. If the operator has no interval, the result is the index of the
    lexeme after the operator.
    """
    items = failure.lexemes
    last = len(items) - 1
    behind = min(index + 1, last)
    if items[behind].text == "@":
        behind = min(behind + 1, last)
    for bracket in brackets(items):
        if bracket.opening == items[behind] and bracket.closing is not None:
            inside = items[behind : items.index(bracket.closing)]
            if bracket.opening.text == "[" or any(lexeme.text == "," for lexeme in inside):
                return min(items.index(bracket.closing) + 1, last)
    return behind


# -------------------------------------------------------------------- E013, E014


def _equals(failure: ParseFailure) -> Diagnostic | None:
    found = failure.found
    if found is None or found.text != "=" or "CMP" not in failure.accepts or "EQUAL" in failure.accepts:
        return None
    span = failure.of(found)
    return Diagnostic(
        "E013", "`=` defines, `==` compares", span, fix=Fix(((span, "=="),), "replace `=` with `==`")
    )


def _vector(failure: ParseFailure) -> Diagnostic | None:
    found, previous = failure.found, failure.previous
    if found is None or previous is None:
        return None
    if previous.text == "]" and failure.wants_operand and found.text in _TAKES_LEFT:
        bracket = next((b for b in brackets(failure.before) if b.closing == previous), None)
        return None if bracket is None else _vector_read_as_interval(failure, bracket, found)
    if found.text in (",", "]") and failure.open_brackets and failure.open_brackets[-1].interval:
        return _not_two_bounds(failure, failure.open_brackets[-1].opening, found)
    return None


def _vector_read_as_interval(failure: ParseFailure, bracket: Bracket, found: Lexeme) -> Diagnostic | None:
    inside = [x for x in failure.before if x.start > bracket.opening.start][:-1]
    if not bracket.interval or bracket.closing is None:
        return None
    # bounds that look like times are those of an interval
    units = {"s", "ms", "us", "ns", "min", "h", "step", "steps"}
    for before, x in zip([inside[0], *inside], inside, strict=False):
        if x.text in ("T", "end", "inf", "dt") or (x.text in units and before.kind == "number"):
            return None
    operator = failure.before[failure.before.index(bracket.opening) - 1]
    index = len(failure.before)
    last = failure.lexemes[max(failure.operand_after(index) - 1, index)]
    read, rest = failure.of(bracket.opening, bracket.closing), failure.of(found, last)
    bounds = " to ".join(part.strip() for part in read.text[1:-1].split(",", 1))
    return Diagnostic(
        "E014",
        f"`[` after `{operator.text}` starts a time interval",
        read,
        f"read as the interval from {bounds}",
        (rest.label("so this has no left-hand side"),),
        help=(f"{operator.text} ({read.text} {rest.text})     or name it:  def p = {read.text}",),
    )


def _not_two_bounds(failure: ParseFailure, opening: Lexeme, found: Lexeme) -> Diagnostic | None:
    index = failure.before.index(opening)
    operator = failure.before[index - 1]
    if opening.text != "[" or not opens_interval(operator):
        return None
    written = failure.piece.source.text[opening.end : found.start].strip()
    if found.text == "]":
        advice = f"{operator.text}[0, {written}] …" if written else f"{operator.text}[0, T] …"
        label = "it needs both ends"
    else:
        advice = f"a vector needs parentheses here:  {operator.text} ([{written}, …] in …)"
        label = "read as an interval, which has two ends"
    span = failure.of(opening, found)
    return Diagnostic(
        "E014", f"`[` after `{operator.text}` starts a time interval", span, label, help=(advice,)
    )


RECOGNISERS: tuple[Recogniser, ...] = (
    _unclosed_text,
    _character,
    _bars,
    _equals,
    _chain,
    misspelt_operator,
    _vector,
    number_over_window,
    definition_of_breach,
    unknown_unit,
    unknown_declaration,
    wrong_name,
    _unclosed,
    stray_bracket,
)
