"""Diagnostic E010, for a syntax error that is not a common mistake: the expected tokens, and a repair.

The message names the expected kinds of token (the terminals of the grammar) in words. A repair is offered
only if the repaired text parses.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar.errors.failure import ParseFailure
from stlc.grammar.errors.units import unit_advice
from stlc.grammar.scan import CLOSES, Lexeme, brackets, closes
from stlc.grammar.words import DECLARATIONS, OPERATORS, RESERVED, ROLES
from stlc.similar import closest
from stlc.source import Label, Span
from stlc.units import Unit

MAX_WORDS = 4

NOUNS: Mapping[str, str] = MappingProxyType(
    {
        "require": "requirement",
        "assume": "assumption",
        "def": "definition",
        "const": "constant",
        "param": "parameter",
        "signal": "signal",
        "region": "region",
        "enum": "enum",
        "fn": "function",
        "spec": "specification",
    }
)
_SIGNS: Mapping[str, str] = MappingProxyType(
    {
        **{"COLON": ":", "EQUAL": "=", "COMMA": ",", "RPAR": ")", "RSQB": "]", "RBRACE": "}"},
        **{"LPAR": "(", "LSQB": "[", "LBRACE": "{", "TILDE": "~", "_DOTS": "..", "_ARROW": "->"},
        **{"_IN": "in", "_THEN": "then", "_ELSE": "else", "_FN": "fn", "_SIGNAL": "signal"},
        **{"_FROM": "from", "_AS": "as"},
    }
)
_REPAIRS = ("COLON", "COMMA", "EQUAL", "RPAR", "RSQB", "RBRACE", "_DOTS", "_ARROW", "_IN", "_FN")
_CLOSING = ("RPAR", "RSQB", "RBRACE")
_LETTERS = frozenset(word for word in OPERATORS if len(word) == 1)
_POSTFIX = frozenset({"LPAR", "LSQB", "DOT"})
_BEFORE_FORMULA = frozenset(
    {":", "and", "&", "&&", "or", "|", "||", "xor", "->", "=>", "implies", "not", "!"}
)


def expected(failure: ParseFailure) -> Diagnostic:
    """Return the diagnostic E010, with the expected tokens, for an error that is not a common mistake."""
    repair = _repair(failure)
    if repair is not None:
        return repair
    words = _words(failure)
    choice = f"{', '.join(words[:-1])} or {words[-1]}" if len(words) > 1 else words[0]
    message = f"expected {choice}{_context(failure)}, found {_found(failure)}"
    label = "" if failure.found is not None else f"expected {words[0]} here"
    advice = _product(failure)
    near = (failure.found, failure.previous) if failure.wants_operand else ()
    letter = next((lexeme.text for lexeme in near if lexeme is not None and lexeme.text in _LETTERS), None)
    notes: tuple[str, ...] = ()
    if letter is not None:  # it may be meant as a name
        operator = OPERATORS[letter].name
        notes = (f"`{letter}` means `{operator}`; a name of your own is written `` `{letter}` ``",)
    return Diagnostic("E010", message, failure.span, label, _labels(failure), advice, notes)


def point(failure: ParseFailure, lexeme: Lexeme) -> Span:
    """Return the source location of the first character of `lexeme`, a word or sign."""
    return failure.piece.source.span(lexeme.start, lexeme.start + 1)


# ---------------------------------------------------------------------- recognisers


def misspelt_operator(failure: ParseFailure) -> Diagnostic | None:
    """Return the finding for a misspelt operator, such as `alwyas[0, T] p` or `p adn q`; else None.

    The text must parse with the corrected operator.
    """
    near_by = [x for x in (failure.found, *reversed(failure.before)) if x is not None and x.kind == "word"]
    for lexeme in near_by[:_NEAR_BY]:
        if lexeme.text in RESERVED or len(lexeme.text) < _LEAST_LETTERS:
            continue
        near = closest(lexeme.text, _OPERATORS)
        if near is not None and failure.piece.repaired_by(lexeme.start, lexeme.end, near):
            return Diagnostic(
                "E010",
                f"unknown operator `{lexeme.text}`",
                failure.of(lexeme),
                help=(f"did you mean `{near}`?",),
            )
    return None


_OPERATORS = (
    *dict.fromkeys(each.name for each in OPERATORS.values()),
    *("and", "or", "xor", "not", "implies", "forall", "exists", "freeze", "then", "else"),
)
_NEAR_BY, _LEAST_LETTERS = 4, 3


def unknown_unit(failure: ParseFailure) -> Diagnostic | None:
    """Return the finding for a number before a word that is not a unit, such as `5 furlong`; else None."""
    found, previous = failure.found, failure.previous
    if found is None or previous is None or previous.kind != "number" or found.kind != "word":
        return None
    if found.text in RESERVED or "UNIT" not in failure.accepts or _begins_line(failure, found):
        return None
    advice = Unit.celsius_advice(found.text) or unit_advice(found.text)
    product = f"a product is written with a sign: `{previous.text} * {found.text}`"
    return Diagnostic("E101", f"unknown unit `{found.text}`", failure.of(found), help=(*advice, product))


def unknown_declaration(failure: ParseFailure) -> Diagnostic | None:
    """Return the finding for an unknown word where a declaration begins, as in `requre a: …`; else None."""
    found = failure.found
    if found is None or found.kind != "word" or found.text in RESERVED or "_REQUIRE" not in failure.accepts:
        return None
    if not _begins_line(failure, found):
        return None
    return Diagnostic(
        "E010",
        f"expected a declaration, found `{found.text}`",
        failure.of(found),
    ).near(
        found.text,
        (*DECLARATIONS, *ROLES, "spec", "system", "time"),
        listed=f"declarations: {' '.join(DECLARATIONS)}",
    )


def wrong_name(failure: ParseFailure) -> Diagnostic | None:
    """Return the finding for a reserved word in place of a name, as in `const in = 3`; else None."""
    if "NAME" not in failure.accepts or failure.wants_operand:
        return None
    found = failure.found
    if found is None and failure.previous is not None and failure.follower is not None:
        same_line = "\n" not in failure.piece.source.text[failure.previous.end : failure.follower.start]
        found = failure.follower if same_line else None
    if found is None or found.text not in RESERVED:
        return None
    operator = OPERATORS.get(found.text)
    means = "" if operator is None or operator.name == found.text else f" (it means `{operator.name}`)"
    span = failure.of(found)
    return Diagnostic(
        "E010",
        f"`{found.text}` is a reserved word{means}, not a name",
        span,
        help=(f"choose another name, or write it in backticks: `` `{found.text}` ``",),
        fix=Fix(((span, f"`{found.text}`"),)),
    )


def stray_bracket(failure: ParseFailure) -> Diagnostic | None:
    """Return the finding for a closing bracket without a matching opening one; else None."""
    found = failure.found
    if found is None or found.text not in (")", "]", "}"):
        return None
    if not failure.open_brackets:
        return Diagnostic("E010", f"this `{found.text}` closes nothing", failure.of(found))
    bracket = failure.open_brackets[-1]
    if closes(bracket, found.text):
        return None
    return Diagnostic(
        "E010",
        f"this `{found.text}` does not close `{bracket.opening.text}`",
        failure.of(found),
        labels=(failure.of(bracket.opening).label("opened here"),),
    )


def _begins_line(failure: ParseFailure, lexeme: Lexeme) -> bool:
    source = failure.piece.source
    line = source.line_starts[source.position(lexeme.start)[0] - 1]
    return not source.text[line : lexeme.start].strip()


# -------------------------------------------------------------------------- repairs


def _repair(failure: ParseFailure) -> Diagnostic | None:
    """Return the diagnostic of a missing or wrong sign, such as a missing `)`; else None.

    The text must parse once the sign is inserted or replaced.
    """
    previous, found = failure.previous, failure.found
    if previous is None:
        return None
    definition = _definition_colon(failure)
    if definition is not None:
        return definition
    for terminal in _REPAIRS:
        if terminal not in failure.accepts or (terminal == "_IN" and failure.wants_operator):
            continue
        bracket = failure.open_brackets[-1] if failure.open_brackets and terminal in _CLOSING else None
        sign = _SIGNS[terminal] if bracket is None else CLOSES[bracket.opening.text]
        glued = sign in ":,)]}"
        inserted = sign if glued else f" {sign}"
        sure = bracket is None or not bracket.interval  # `]` and `)` close intervals with different meanings
        if failure.piece.repaired_by(previous.end, previous.end, inserted):
            return _missing(failure, sign, previous.end, previous.end, inserted, sure=sure)
        if found is not None and failure.piece.repaired_by(found.start, found.end, sign):
            start = previous.end if glued else found.start
            return _missing(failure, sign, start, found.end, sign, sure=sure)
    return None


def _definition_colon(failure: ParseFailure) -> Diagnostic | None:
    """Return the diagnostic for `def name: …` in place of `def name = …`; else None.

    The parser reads the text after the colon as a type.
    """
    declared = _declared(failure)
    sign = next((lexeme for lexeme in failure.before if lexeme.text == ":"), None)
    if declared is None or sign is None or declared[1] not in ("definition", "constant", "region"):
        return None
    if not failure.piece.repaired_by(sign.start, sign.end, " ="):
        return None
    return _missing(ParseFailure(failure.piece, sign.start), "=", sign.start, sign.end, " =")


def _missing(
    failure: ParseFailure, sign: str, low: int, high: int, text: str, *, sure: bool = True
) -> Diagnostic:
    """Return the diagnostic for the missing sign `sign`, with the corrected line as help.

    In the corrected line, `text` replaces the characters from offset `low` to `high`. If `sure`, an editor or
    `stlc lint --fix` can apply this correction.
    """
    label = f"expected `{sign}` before this" if low == high and failure.found is not None else ""
    return Diagnostic(
        "E010",
        f"expected `{sign}`{_context(failure)}, found {_found(failure)}",
        failure.span,
        label,
        _labels(failure),
        help=(failure.line_with((low, high, text)),),
        fix=Fix(((failure.piece.source.span(low, high), text),)) if sure else None,
    )


def _product(failure: ParseFailure) -> tuple[str, ...]:
    """Return advice if the error is a product written without `*`, such as `2 (x + 1)`; else ()."""
    previous, found = failure.previous, failure.found
    if previous is None or found is None or "MULOP" not in failure.accepts or "UNIT" in failure.accepts:
        return ()
    if previous.text in ("deg", "°") and found.text == "C":
        return (Unit.CELSIUS,)
    if not failure.piece.repaired_by(previous.end, previous.end, " *"):
        return ()
    return (f"a product is written with a sign: {failure.line_with((previous.end, previous.end, ' *'))}",)


# ---------------------------------------------------------------------------- words


def _words(failure: ParseFailure) -> list[str]:
    accepts = failure.accepts
    words: list[str] = []
    if failure.wants_operand:
        words.append(_operand(failure))
    elif "NAME" in accepts:
        words.append("a type" if failure.previous and failure.previous.text == ":" else "a name")
    optional = _POSTFIX if failure.wants_operator or "_REQUIRE" in accepts else frozenset()
    if not failure.wants_operand:
        words += [
            f"`{sign}`" for name, sign in _SIGNS.items() if name in accepts - optional - {"_IN", "_SIGNAL"}
        ]
        words += ["`in`"] if "_IN" in accepts and not failure.wants_operator else []
    words += [word for name, word in _CLASSES.items() if name in accepts and not failure.wants_operand]
    words += ["an operator"] if failure.wants_operator else []
    words += ["a declaration"] if "_REQUIRE" in accepts else []
    words += ["the end of the expression"] if failure.piece.rule == "expr" and "$END" in accepts else []
    return words[:MAX_WORDS] or ["something else"]


_CLASSES: Mapping[str, str] = MappingProxyType(
    {
        "STRING": "a text in quotes",
        "TIME_UNIT": "a unit of time (s, ms, us, ns, min, h or steps)",
        "UNIT_BRACKET": "a unit like [m/s]",
    }
)


def _operand(failure: ParseFailure) -> str:
    if "UNARY" not in failure.accepts:
        return "a value"
    previous = failure.previous
    operator = None if previous is None else OPERATORS.get(previous.text)
    unary = operator is not None and not operator.binary
    if previous is None or previous.text in _BEFORE_FORMULA or unary:
        return "a formula" if failure.piece.rule == "start" else "an expression"
    if operator is not None or ("RPAR" not in failure.accepts and previous.text in ("]", ")")):
        return "a formula"
    return "an expression"


def _context(failure: ParseFailure) -> str:
    previous = failure.previous
    if previous is None:
        return ""
    name = _declared(failure)
    if name is not None and name[0] == previous:
        return f" after the {name[1]}'s name"
    if any(bracket.interval and bracket.closing == previous for bracket in brackets(failure.before)):
        return " after the interval"
    return f" after `{_shortened(previous.text)}`"


def _declared(failure: ParseFailure) -> tuple[Lexeme, str] | None:
    """Return (name, kind in words) of the first declaration in the text before the error, or None."""
    for keyword, name in zip(failure.before, failure.before[1:], strict=False):
        if keyword.text in NOUNS and name.kind in ("word", "quoted"):
            return name, NOUNS[keyword.text]
    return None


def _labels(failure: ParseFailure) -> tuple[Label, ...]:
    name = _declared(failure)
    if name is None or name[0] != failure.previous:
        return ()
    return (failure.of(name[0]).label(f"the {name[1]}'s name"),)


def _found(failure: ParseFailure) -> str:
    if failure.found is not None:
        return f"`{_shortened(failure.found.text)}`"
    if failure.piece.rule == "expr":
        return "the end of the expression"
    return "the end of the file" if failure.follower is None else "the next declaration"


def _shortened(text: str) -> str:
    return text if len(text) <= 24 else f"{text[:23]}…"
