"""The general syntax error, E010: what could have stood here, in words, and the smallest repair.

Terminals of the grammar become words and classes of words; a repair is offered only if it parses.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from stlc.diagnostics import Diagnostic, Fix, Label
from stlc.grammar.errors.failure import Stumble
from stlc.grammar.parse.literals import near_unit
from stlc.grammar.scan import Lexeme, brackets, closes
from stlc.grammar.words import BINARY_TEMPORAL, DECLARATIONS, RESERVED, ROLES, UNARY_TEMPORAL
from stlc.registry import closest
from stlc.source import Span
from stlc.units import CELSIUS, means_celsius

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
_POSTFIX = frozenset({"LPAR", "LSQB", "DOT"})
_BEFORE_FORMULA = frozenset(
    {":", "and", "&", "&&", "or", "|", "||", "xor", "->", "=>", "implies", "not", "!"}
)


def expected(stumble: Stumble) -> Diagnostic:
    """E010 for a stumble that no recogniser knows."""
    repair = _repair(stumble)
    if repair is not None:
        return repair
    words = _words(stumble)
    message = f"expected {_joined(words)}{_context(stumble)}, found {_found(stumble)}"
    label = "" if stumble.found is not None else f"expected {words[0]} here"
    advice = _product(stumble)
    return Diagnostic("E010", message, stumble.span, label, _labels(stumble), advice, _notes(stumble))


def point(stumble: Stumble, lexeme: Lexeme) -> Span:
    """The first character of a lexeme."""
    return stumble.piece.source.span(lexeme.start, lexeme.start + 1)


# ---------------------------------------------------------------------- recognisers


def misspelt_operator(stumble: Stumble) -> Diagnostic | None:
    """A word that is nearly an operator, and with that the piece parses: `alwyas[0, T] p`, `p adn q`."""
    near_by = [x for x in (stumble.found, *reversed(stumble.before)) if x is not None and x.kind == "word"]
    for lexeme in near_by[:_NEAR_BY]:
        if lexeme.text in RESERVED or len(lexeme.text) < _LEAST_LETTERS:
            continue
        near = closest(lexeme.text, _OPERATORS)
        if near is not None and stumble.piece.repaired_by(lexeme.start, lexeme.end, near):
            return Diagnostic(
                "E010",
                f"unknown operator `{lexeme.text}`",
                stumble.of(lexeme),
                help=(f"did you mean `{near}`?",),
            )
    return None


_OPERATORS = (
    *("always", "eventually", "once", "historically", "until", "release", "unless", "since"),
    *("and", "or", "xor", "not", "implies", "forall", "exists", "freeze", "then", "else"),
)
_NEAR_BY, _LEAST_LETTERS = 4, 3


def unknown_unit(stumble: Stumble) -> Diagnostic | None:
    """A word behind a number that is no unit: `5 furlong`, `2 x`."""
    found, previous = stumble.found, stumble.previous
    if found is None or previous is None or previous.kind != "number" or found.kind != "word":
        return None
    if found.text in RESERVED or "UNIT" not in stumble.accepts or _begins_line(stumble, found):
        return None
    near = near_unit(found.text)
    advice = (CELSIUS,) if means_celsius(found.text) else (f"did you mean `{near}`?",) if near else ()
    product = f"a product is written with a sign: `{previous.text} * {found.text}`"
    return Diagnostic("E101", f"unknown unit `{found.text}`", stumble.of(found), help=(*advice, product))


def unknown_declaration(stumble: Stumble) -> Diagnostic | None:
    """A word at the start of a line that begins no declaration: `requre a: …`."""
    found = stumble.found
    if found is None or found.kind != "word" or found.text in RESERVED or "_REQUIRE" not in stumble.accepts:
        return None
    if not _begins_line(stumble, found):
        return None
    near = closest(found.text, (*DECLARATIONS, *ROLES, "spec", "system", "time"))
    advice = f"did you mean `{near}`?  " if near else ""
    return Diagnostic(
        "E010",
        f"expected a declaration, found `{found.text}`",
        stumble.of(found),
        help=(f"{advice}declarations: {' '.join(DECLARATIONS)}",),
    )


def wrong_name(stumble: Stumble) -> Diagnostic | None:
    """A reserved word where a name is due: `def F = …`, `const in = 3`."""
    if "NAME" not in stumble.accepts or stumble.wants_operand:
        return None
    found = stumble.found
    if found is None and stumble.previous is not None and stumble.follower is not None:
        same_line = "\n" not in stumble.piece.source.text[stumble.previous.end : stumble.follower.start]
        found = stumble.follower if same_line else None
    if found is None or found.text not in RESERVED:
        return None
    meaning = UNARY_TEMPORAL.get(found.text) or BINARY_TEMPORAL.get(found.text)
    means = f" (it means `{meaning}`)" if meaning not in (None, found.text) else ""
    span = stumble.of(found)
    return Diagnostic(
        "E010",
        f"`{found.text}` is a reserved word{means}, not a name",
        span,
        help=(f"choose another name, or write it in backticks: `` `{found.text}` ``",),
        fix=Fix(((span, f"`{found.text}`"),)),
    )


def stray_bracket(stumble: Stumble) -> Diagnostic | None:
    """A closing bracket that closes nothing, or something else."""
    found = stumble.found
    if found is None or found.text not in (")", "]", "}"):
        return None
    if not stumble.open_brackets:
        return Diagnostic("E010", f"this `{found.text}` closes nothing", stumble.of(found))
    bracket = stumble.open_brackets[-1]
    if closes(bracket, found.text):
        return None
    return Diagnostic(
        "E010",
        f"this `{found.text}` does not close `{bracket.opening.text}`",
        stumble.of(found),
        labels=(Label(stumble.of(bracket.opening), "opened here"),),
    )


def _begins_line(stumble: Stumble, lexeme: Lexeme) -> bool:
    source = stumble.piece.source
    line = source.line_starts[source.position(lexeme.start)[0] - 1]
    return not source.text[line : lexeme.start].strip()


# -------------------------------------------------------------------------- repairs


def _repair(stumble: Stumble) -> Diagnostic | None:
    """The finding that one sign is missing or wrong, if with it the piece parses."""
    previous, found = stumble.previous, stumble.found
    if previous is None:
        return None
    definition = _definition_colon(stumble)
    if definition is not None:
        return definition
    for terminal in _REPAIRS:
        if terminal not in stumble.accepts or (terminal == "_IN" and stumble.wants_operator):
            continue
        sign = _closing(stumble) or _SIGNS[terminal] if terminal in _CLOSING else _SIGNS[terminal]
        glued = sign in ":,)]}"
        inserted = sign if glued else f" {sign}"
        sure = terminal not in _CLOSING or not _open_interval(stumble)
        if stumble.piece.repaired_by(previous.end, previous.end, inserted):
            return _missing(stumble, sign, (previous.end, previous.end, inserted), sure=sure)
        if found is not None and stumble.piece.repaired_by(found.start, found.end, sign):
            start = previous.end if glued else found.start
            return _missing(stumble, sign, (start, found.end, sign), sure=sure)
    return None


def _open_interval(stumble: Stumble) -> bool:
    """Whether an interval is open, which `]` and `)` close with different meanings."""
    return bool(stumble.open_brackets) and stumble.open_brackets[-1].interval


def _closing(stumble: Stumble) -> str | None:
    """What closes the bracket that was opened last."""
    if not stumble.open_brackets:
        return None
    return {"(": ")", "[": "]", "{": "}"}.get(stumble.open_brackets[-1].opening.text)


def _definition_colon(stumble: Stumble) -> Diagnostic | None:
    """`def name: …`, where `=` is due; the parser took what follows for a type."""
    declared = _declared(stumble)
    sign = next((lexeme for lexeme in stumble.before if lexeme.text == ":"), None)
    if declared is None or sign is None or declared[1] not in ("definition", "constant", "region"):
        return None
    if not stumble.piece.repaired_by(sign.start, sign.end, " ="):
        return None
    return _missing(Stumble(stumble.piece, sign.start), "=", (sign.start, sign.end, " ="))


def _missing(stumble: Stumble, sign: str, edit: tuple[int, int, str], *, sure: bool = True) -> Diagnostic:
    """That a sign is missing; where it is not `sure` that no other one was meant, nothing is repaired."""
    low, high, text = edit
    label = f"expected `{sign}` before this" if low == high and stumble.found is not None else ""
    return Diagnostic(
        "E010",
        f"expected `{sign}`{_context(stumble)}, found {_found(stumble)}",
        stumble.span,
        label,
        _labels(stumble),
        help=(stumble.line_with(edit),),
        fix=Fix(((stumble.piece.source.span(low, high), text),)) if sure else None,
    )


def _product(stumble: Stumble) -> tuple[str, ...]:
    """`2 (x + 1)`, `x y`: a product without its sign."""
    previous, found = stumble.previous, stumble.found
    if previous is None or found is None or "MULOP" not in stumble.accepts or "UNIT" in stumble.accepts:
        return ()
    if previous.text in ("deg", "°") and found.text == "C":
        return (CELSIUS,)
    if not stumble.piece.repaired_by(previous.end, previous.end, " *"):
        return ()
    return (f"a product is written with a sign: {stumble.line_with((previous.end, previous.end, ' *'))}",)


# ---------------------------------------------------------------------------- words


def _words(stumble: Stumble) -> list[str]:
    accepts = stumble.accepts
    words: list[str] = []
    if stumble.wants_operand:
        words.append(_operand(stumble))
    elif "NAME" in accepts:
        words.append("a type" if stumble.previous and stumble.previous.text == ":" else "a name")
    optional = _POSTFIX if stumble.wants_operator or "_REQUIRE" in accepts else frozenset()
    if not stumble.wants_operand:
        words += [
            f"`{sign}`" for name, sign in _SIGNS.items() if name in accepts - optional - {"_IN", "_SIGNAL"}
        ]
        words += ["`in`"] if "_IN" in accepts and not stumble.wants_operator else []
    words += [word for name, word in _CLASSES.items() if name in accepts and not stumble.wants_operand]
    words += ["an operator"] if stumble.wants_operator else []
    words += ["a declaration"] if "_REQUIRE" in accepts else []
    words += ["the end of the expression"] if stumble.piece.rule == "expr" and "$END" in accepts else []
    return words[:MAX_WORDS] or ["something else"]


_CLASSES: Mapping[str, str] = MappingProxyType(
    {
        "STRING": "a text in quotes",
        "TIME_UNIT": "a unit of time (s, ms, us, ns, min, h or steps)",
        "UNIT_BRACKET": "a unit like [m/s]",
    }
)


def _operand(stumble: Stumble) -> str:
    if "UNARY" not in stumble.accepts:
        return "a value"
    previous = stumble.previous
    if previous is None or previous.text in _BEFORE_FORMULA or previous.text in UNARY_TEMPORAL:
        return "a formula" if stumble.piece.rule == "start" else "an expression"
    if previous.text in BINARY_TEMPORAL or ("RPAR" not in stumble.accepts and previous.text in ("]", ")")):
        return "a formula"
    return "an expression"


def _context(stumble: Stumble) -> str:
    previous = stumble.previous
    if previous is None:
        return ""
    name = _declared(stumble)
    if name is not None and name[0] == previous:
        return f" after the {name[1]}'s name"
    if any(bracket.interval and bracket.closing == previous for bracket in brackets(stumble.before)):
        return " after the interval"
    return f" after `{_shortened(previous.text)}`"


def _declared(stumble: Stumble) -> tuple[Lexeme, str] | None:
    """The name that the piece declares, and what it is the name of."""
    for keyword, name in zip(stumble.before, stumble.before[1:], strict=False):
        if keyword.text in NOUNS and name.kind in ("word", "quoted"):
            return name, NOUNS[keyword.text]
    return None


def _labels(stumble: Stumble) -> tuple[Label, ...]:
    name = _declared(stumble)
    if name is None or name[0] != stumble.previous:
        return ()
    return (Label(stumble.of(name[0]), f"the {name[1]}'s name"),)


def _found(stumble: Stumble) -> str:
    if stumble.found is not None:
        return f"`{_shortened(stumble.found.text)}`"
    if stumble.piece.rule == "expr":
        return "the end of the expression"
    return "the end of the file" if stumble.follower is None else "the next declaration"


def _notes(stumble: Stumble) -> tuple[str, ...]:
    if not stumble.wants_operand:
        return ()
    for lexeme in (stumble.found, stumble.previous):
        if lexeme is not None and lexeme.text in ("F", "G", "U"):
            name, meaning = lexeme.text, UNARY_TEMPORAL.get(lexeme.text, "until")
            return (f"`{name}` means `{meaning}`; a name of your own is written `` `{name}` ``",)
    return ()


def _joined(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def _shortened(text: str) -> str:
    return text if len(text) <= 24 else f"{text[:23]}…"
