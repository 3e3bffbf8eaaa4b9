"""Hover text of the word under the cursor: kind, unit, range, value, and times in seconds and steps."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction

from stlc.compile.frontend.values import Number, Value, VectorValue, describe
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.nodes import Window
from stlc.editor.document import Document, borrowed_at
from stlc.editor.symbols import Symbol
from stlc.editor.vocabulary import BUILT_IN, FUNCTIONS, KEYWORDS, TAGS, TEMPORAL, TYPES
from stlc.escape import markdown, screen, visible
from stlc.grammar import ast
from stlc.grammar.printer import show
from stlc.grammar.scan import Lexeme
from stlc.grammar.spec import STD, Spec
from stlc.grammar.words import OPERATORS
from stlc.source import Span
from stlc.units import time_text

_ALIASES = {word: each.name for word, each in OPERATORS.items()}


def hover(document: Document, offset: int) -> tuple[Span, str] | None:
    """Return (location, hover text in Markdown) for the word under the cursor; None without such a text."""
    found = document.names.at(offset)
    if found is not None:
        return found.span, about(document, found.symbol)
    borrowed = borrowed_at(document.spec, document.modules, offset)
    if borrowed is not None and borrowed.item is not None:
        return borrowed.span, about_shared(borrowed.item, borrowed.module.key)
    lexeme, before = _lexeme(document.source.text, offset)
    node = _temporal_at(document.spec, offset)
    other = lexeme is not None and lexeme.kind == "word" and lexeme.text.rstrip("_") not in _ALIASES
    if node is not None and not other:
        word = (offset, offset) if lexeme is None else (lexeme.start, lexeme.end)
        return _about_temporal(document, node, *word)
    if lexeme is None or lexeme.kind != "word":
        return None
    text = _about_word(document, lexeme.text, tag=before == "@")
    return None if text is None else (document.source.span(lexeme.start, lexeme.end), text)


def _lexeme(text: str, offset: int) -> tuple[Lexeme | None, str]:
    """Return the lexeme (word, number or sign) at an offset, and the text of the lexeme before it, or "".

    At the boundary of two lexemes, a word or number takes precedence over a sign.
    """
    found, before, last = None, "", ""
    for lexeme in Lexeme.scan(text):
        if lexeme.start > offset:
            break
        if lexeme.end >= offset and (found is None or found.kind == "sign"):
            found, before = lexeme, last
        last = lexeme.text
    return found, before


def _about_word(document: Document, word: str, *, tag: bool) -> str | None:
    if tag:
        return TAGS.get(word)
    grid = document.grid
    if word == "dt" and grid.dt is not None:
        return f"{BUILT_IN[word]}\n\n{grid.in_words(Fraction(1))}"
    if word == "T" and grid.horizon is not None:
        return f"{BUILT_IN[word]}\n\n{grid.duration(grid.horizon)}"
    if word in BUILT_IN:
        return BUILT_IN[word]
    for table in (FUNCTIONS, TYPES, KEYWORDS):
        if word in table:
            return table[word]
    return TEMPORAL.get(_ALIASES.get(word.rstrip("_"), ""))


# ------------------------------------------------------------------------- symbols


def about(document: Document, symbol: Symbol) -> str:
    """Return the hover text of a symbol: its declaration, its kind, unit and range, and its `##` comment."""
    item = symbol.item
    parts = [] if item is None else [_code(item)]
    parts += list(_facts(document, symbol))
    if item is not None and item.doc and symbol.kind not in ("argument", "member"):
        parts.append(_comment(item.doc))
    return "\n\n".join(parts)


def _code(item: ast.Declaration) -> str:
    """Return a declaration as a fenced Markdown code block; back quotes in names do not end the block."""
    return f"```stlc\n{screen(show(replace(item, doc='', tags=())))}\n```"


def _comment(doc: str) -> str:
    return "\n".join(map(markdown, doc.split("\n")))


def about_shared(item: ast.Declaration, key: str) -> str:
    """Return the hover text of a declaration `item` in an imported file.

    `key` is the name of the file, or the key of the standard library.
    """
    origin = "library std" if key == STD else markdown_code(key)
    parts = [_code(item), f"from {origin}", _comment(item.doc)]
    return "\n\n".join(filter(None, parts))


def summary(document: Document, symbol: Symbol) -> str:
    """Return one line on a symbol: for example, the kind, unit and range of a signal."""
    return next(iter(_facts(document, symbol)), symbol.kind)


def _facts(document: Document, symbol: Symbol) -> Iterator[str]:
    match symbol.kind:
        case "signal" | "param":
            yield from _about_column(document, symbol)
        case "const" | "region" | "def":
            value = document.meaning.value(symbol.name)
            if value is not None:
                steps = document.meaning.steps(symbol.name)
                ahead = f", looks {document.grid.duration(steps)} ahead" if steps else ""
                yield f"{describe(value)}{_constant(value)}{ahead}"
        case "require" | "assume":
            tags = getattr(symbol.item, "tags", ())
            yield " ".join(("requirement" if symbol.kind == "require" else "assumption", *map(show, tags)))
            steps = document.meaning.steps(symbol.name)
            if steps is not None:
                yield f"horizon {document.grid.duration(steps)}"
        case "member":
            item = symbol.item
            value_ = dict(item.members).get(symbol.name) if isinstance(item, ast.Enum) else None
            yield f"member of {markdown_code(symbol.item.name if symbol.item else '')}, {value_}"
        case "argument":
            yield f"argument of {markdown_code(symbol.item.name if symbol.item else '')}"
        case _:
            yield symbol.kind


def _about_column(document: Document, symbol: Symbol) -> Iterator[str]:
    columns = document.meaning.columns.get(symbol.name, ())
    if not columns:
        return
    first = columns[0]
    unit = f" [{first.unit}]" if first.unit.text else ""
    size = f" vector of {len(columns)}" if len(columns) > 1 or first.name.endswith("[0]") else ""
    values = ""
    if first.labels:
        values = f": {', '.join(f'{name} = {value:g}' for name, value in first.labels)}"
    elif first.kind != "bool" and first.low is not None and first.high is not None:
        plain = f" {first.unit}" if first.unit.text else ""
        nature = "enforced" if first.fact else "nominal"
        values = f", {first.low:g} to {first.high:g}{plain} ({nature})"
    yield f"{first.role} {first.kind}{size}{unit}{values}"
    system = document.system
    if system is not None and first.name.removesuffix("[0]") in system.places:
        place = system.places[first.name.removesuffix("[0]")]
        yield f"a state of {markdown_code(system.path.name)}, line {place.line}"


def _constant(value: Value) -> str:
    match value:
        case Number() if value.constant is not None:
            return f" = {_amount(value)}"
        case VectorValue(items) if all(item.constant is not None for item in items):
            return f" = [{', '.join(map(_amount, items))}]"
        case _:
            return ""


def _amount(number: Number) -> str:
    unit = number.unit.text
    return f"{(number.constant or 0.0) / number.unit.scale:.6g} {unit}".rstrip()


# ------------------------------------------------------------------- temporal words


def _temporal_at(spec: Spec, offset: int) -> ast.Temporal | ast.Until | None:
    """Return the innermost temporal operator whose word or interval is under the cursor, or None."""
    found = None
    for node in spec.walk():
        if not isinstance(node, ast.Temporal | ast.Until):
            continue
        first = node.span.start if isinstance(node, ast.Temporal) else node.left.span.end + 1
        body = node.body if isinstance(node, ast.Temporal) else node.right
        last = body.span.start if node.interval is None else node.interval.span.end
        if first <= offset <= last:
            found = node
    return found


def _about_temporal(
    document: Document, node: ast.Temporal | ast.Until, start: int, end: int
) -> tuple[Span, str]:
    """Return (location, hover text) of a temporal operator whose word is at `start` to `end`.

    The location extends to the end of the operator's interval, if it has one.
    """
    if node.interval is None:
        time = "up to now" if OPERATORS[node.op].past else "from now to the end of the trace"
    else:
        span = node.interval.span
        start, end = min(start, span.start), max(end, span.end)
        found = document.meaning.interval(span)
        time = "" if found is None else _time(node.op, *found, document.grid)
    return document.source.span(start, end), "\n\n".join(filter(None, (TEMPORAL[node.op], time)))


def _time(op: str, interval: typed.Interval, window: Window | None, grid: Grid) -> str:
    if window is None:
        return ""
    samples = f"samples {window.lo}..{'end' if window.hi is None else window.hi}"
    if OPERATORS[op].past:
        samples += " back"
    if interval.clock == "start":
        samples += " of the mission"
    if grid.dt is None:
        return samples
    last = "end" if window.hi is None else grid.in_words(Fraction(window.hi))
    opening, closing = "(" if interval.lo_open else "[", ")" if interval.hi_open else "]"
    lo = _seconds(interval.lo, grid) or grid.in_words(Fraction(window.lo))
    hi = last if interval.hi is None else _seconds(interval.hi, grid) or last
    return f"{opening}{lo}, {hi}{closing} = {samples}"


def _seconds(time: typed.Time, grid: Grid) -> str:
    """Return an end of an interval as text in seconds, such as `2.5 s`.

    The result is "" if the time step is unknown. It is also "" if the end refers to the horizon, and the
    horizon is unknown.
    """
    if grid.dt is None or (time.horizons and grid.horizon is None):
        return ""
    seconds = time.seconds + grid.dt * (time.steps + time.horizons * (grid.horizon or 0))
    return time_text(seconds)


def markdown_code(text: str) -> str:
    """Return a name as inline code in Markdown; back quotes in the name are kept."""
    words = visible(text)
    longest = max(map(len, re.findall("`+", words)), default=0)
    fence = "`" * (longest + 1)
    blank = " " if words.startswith("`") or words.endswith("`") or words != words.strip() or not words else ""
    return f"{fence}{blank}{words}{blank}{fence}"
