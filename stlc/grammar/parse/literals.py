"""Tokens -> names, units and numbers: what well-formed text may still get wrong is reported here."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from fractions import Fraction

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar.words import BUILT_IN, UNIT_NAMES
from stlc.registry import closest
from stlc.source import Source, Span
from stlc.units import CELSIUS, SYMBOLS, means_celsius, parse_unit

MAX_DIGITS = 400
_UNIT_LENGTH = 60
_LARGEST = Fraction(1.7976931348623157e308)
_MANTISSA = re.compile(r"([^eE]*)(?:[eE]([+-]?\d+))?")
_WORD = re.compile(r"[A-Za-z]+")


@dataclass(frozen=True, slots=True)
class TerminalToken:
    """A token: the name of its terminal, its text and its place."""

    kind: str
    text: str
    span: Span


@dataclass(slots=True)
class Context:
    """What a rule may need besides its children.

    Attributes:
        source: the whole text.
        findings: what is wrong with well-formed text (a number too large, an unknown unit).
        documented: offset up to which `##` comments are spoken for.
    """

    source: Source
    findings: list[Diagnostic] = field(default_factory=list)
    documented: int = 0


def name_of(leaf: TerminalToken) -> str:
    """The name that a NAME token writes, without its backticks."""
    return leaf.text[1:-1] if leaf.text.startswith("`") else leaf.text


def own_name(context: Context, leaf: TerminalToken) -> str:
    """The name that a declaration gives; `T`, `end` and `dt` only in backticks."""
    if leaf.text in BUILT_IN:
        context.findings.append(
            Diagnostic(
                "E010",
                f"`{leaf.text}` is {BUILT_IN[leaf.text]}, not a name of your own",
                leaf.span,
                help=(f"choose another name, or write it in backticks: `` `{leaf.text}` ``",),
                fix=Fix(((leaf.span, f"`{leaf.text}`"),)),
            )
        )
    return name_of(leaf)


def unit_of(context: Context, leaf: TerminalToken | None) -> str:
    """The unit that a UNIT or UNIT_BRACKET token writes; "" if there is none."""
    if leaf is None:
        return ""
    text = re.sub(r"\s+", "", leaf.text.strip("[]"))
    if text in ("step", "steps"):
        return "steps"
    try:
        if len(text) > _UNIT_LENGTH:
            raise ValueError("this is too long for a unit")
        parse_unit(text)
    except ValueError as error:
        context.findings.append(_bad_unit(leaf, text, str(error)))
    return text


def _bad_unit(leaf: TerminalToken, text: str, reason: str) -> Diagnostic:
    if "," in text:
        advice: tuple[str, ...] = (f"a range is written `in {leaf.text}`",)
    elif means_celsius(text.strip("[] ")):
        advice = (CELSIUS,)
    else:
        near = next((found for word in _WORD.findall(text) if (found := near_unit(word))), None)
        advice = (f"did you mean `{near}`?",) if near else ()
    return Diagnostic(
        "E101", reason, leaf.span, help=advice, note=("a unit is a product of powers: [m/s^2], [1/s], [%]",)
    )


def near_unit(word: str) -> str | None:
    """The unit that somebody means who writes `word`, if it is none."""
    return (
        None
        if word in SYMBOLS or means_celsius(word)
        else UNIT_NAMES.get(word.lower()) or closest(word, SYMBOLS)
    )


def number_of(context: Context, leaf: TerminalToken) -> Fraction:
    """The exact value of a NUMBER token; E005 and 0 if it is beyond double precision."""
    match = _MANTISSA.fullmatch(leaf.text)
    assert match is not None
    digits, exponent = match[1].replace("_", ""), match[2] or "0"
    if len(digits) <= MAX_DIGITS and len(exponent) <= 4 and abs(int(exponent)) <= MAX_DIGITS:
        value = Fraction(digits.rstrip(".") or "0") * Fraction(10) ** int(exponent)
        if value <= _LARGEST:
            return value
    context.findings.append(
        Diagnostic(
            "E005",
            "this number is beyond double precision",
            leaf.span,
            note=("the largest is about 1.8e308",),
        )
    )
    return Fraction(0)
