"""Requirements as English sentences."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from stlc.grammar import ast
from stlc.grammar.printer import show_expr, show_set
from stlc.grammar.spec import Spec
from stlc.grammar.words import OPERATORS

_EDGES = {"rise": "{} becomes true", "fall": "{} becomes false"}
_OPENINGS = frozenset({"at", "if", "for", "let", "it", "either", "nothing"})
_EQUAL = {"==": "is", "!=": "is not"}


def sentence(item: ast.Require | ast.Assume) -> str:
    """Return a requirement as one English sentence."""
    text = say(item.formula)
    begins = text.partition(" ")[0] in _OPENINGS
    return f"{text[0].upper()}{text[1:]}." if begins else f"{text}."


_NAMED = ast.Def | ast.Region | ast.Const


REPEATED = 200_000
"""Limit in characters up to which a definition is repeated with each requirement that uses it."""


class Meanings:
    """Descriptions in words of the definitions of a specification; each is computed once."""

    def __init__(self, spec: Spec) -> None:
        self._known = {entry.name: entry for entry in spec.items if isinstance(entry, _NAMED)}
        self._words: dict[str, str] = {}
        self._uses: dict[str, list[str]] = {}
        self._letters = 0

    def of(self, item: ast.Require | ast.Assume) -> list[tuple[str, str]]:
        """Return (name, description) for each definition that a requirement uses, directly or indirectly.

        A definition that several requirements use is described again for each of them. Once all descriptions
        returned so far exceed `REPEATED` characters, only definitions that were not yet described are
        included.
        """
        found: dict[str, str] = {}
        queue = deque(self._used(item.formula))
        while queue:
            name = queue.popleft()
            if name in found or (name in self._words and self._letters > REPEATED):
                continue
            entry = self._known[name]
            if name not in self._words:
                self._words[name], self._uses[name] = _meaning(entry), self._used(entry.value)
            found[name] = self._words[name]
            self._letters += len(found[name])
            queue.extend(self._uses[name])
        return list(found.items())

    def sentence(self, item: ast.Require | ast.Assume) -> str:
        """Return a requirement as one English sentence, which says so if it reads the first sample only."""
        once = self._reads_once(item.formula)
        return f"At the first sample: {say(item.formula)}." if once else sentence(item)

    def _reads_once(self, expr: ast.Expr) -> bool:
        """True if an expression has no operator of the future, nor has a definition that it uses."""
        names: set[str] = set()
        queue = [expr]
        while queue:
            for node in queue.pop().walk():
                if isinstance(node, ast.Attr):
                    return False
                if isinstance(node, ast.Temporal | ast.Until) and not OPERATORS[node.op].past:
                    return False
                if isinstance(node, ast.Name) and node.name in self._known and node.name not in names:
                    names.add(node.name)
                    queue.append(self._known[node.name].value)
        return True

    def _used(self, expr: ast.Expr) -> list[str]:
        names = (node.name for node in expr.walk() if isinstance(node, ast.Name))
        return list(dict.fromkeys(name for name in names if name in self._known))


def _meaning(entry: ast.Def | ast.Region | ast.Const) -> str:
    if isinstance(entry, ast.Region):
        return show_expr(entry.value)
    if isinstance(entry, ast.Const):
        return show_expr(entry.value) + (f" [{entry.unit}]" if entry.unit else "")
    formulas = ast.Compare | ast.Member | ast.Not | ast.Logic | ast.Temporal | ast.Until | ast.Quantifier
    text = (say if isinstance(entry.value, formulas) else show_expr)(entry.value)
    names = ", ".join(formal.name for formal in entry.formals)
    return f"of {names}: {text}" if names else text


def say(expr: ast.Expr) -> str:
    """Return an expression in words."""
    return _PHRASES.get(type(expr), show_expr)(expr)


def _inner(expr: ast.Expr) -> str:
    """Return an expression in words for use as an operand.

    A formula with a connective or `until` gets parentheses.
    """
    return f"({say(expr)})" if isinstance(expr, ast.Logic | ast.Until) else say(expr)


def _call(expr: ast.Call) -> str:
    match expr:
        case ast.Call(func=ast.Name(name=name), args=(ast.Arg(value=body),)) if name in _EDGES:
            return _EDGES[name].format(show_expr(body))
        case _:
            return show_expr(expr)


# ------------------------------------------------------------------------------ time


def _temporal(expr: ast.Temporal | ast.Until) -> str:
    operator = OPERATORS[expr.op]
    operands = (expr.body,) if isinstance(expr, ast.Temporal) else (expr.left, expr.right)
    phrases = dict(zip("pq", map(_inner, operands), strict=False))
    return operator.english.format(when=_when(expr.interval, past=operator.past), **phrases)


def _when(interval: ast.Interval | None, *, past: bool) -> str:
    """Return the window of a temporal operator in words.

    `past` is True if the window lies in the past.
    """
    if interval is None:
        return "so far" if past else "from now on"
    low, high = show_expr(interval.lo), show_expr(interval.hi)
    ends = [name for name, open_ in (("the start", interval.lo_open), ("the end", interval.hi_open)) if open_]
    edge = f" ({' and '.join(ends)} excluded)" if ends else ""
    if interval.clock == "start":
        return f"between {low} and {high} of the mission{edge}"
    if high in ("end", "inf"):
        start = "from now" if low in ("0", "0 s") else f"from {low} from now"
        return f"so far{edge}" if past else f"{start} on{edge}"
    if low in ("0", "0 s", "0 steps"):
        return f"in the {'last' if past else 'next'} {high}{edge}"
    return f"between {low} and {high} {'ago' if past else 'from now'}{edge}"


# ----------------------------------------------------------------------------- logic


def _logic(expr: ast.Logic) -> str:
    if expr.op == "->":
        return f"if {say(expr.left)}, then {say(expr.right)}"
    one, other = _side(expr.left, expr.op), _side(expr.right, expr.op)
    if expr.op == "xor":
        return f"either {one} or {other}, not both"
    if expr.op == "<->":
        return f"{one} exactly when {other}"
    return f"{one}, {expr.op} {other}" if "," in one or ":" in one else f"{one} {expr.op} {other}"


def _side(expr: ast.Expr, op: str) -> str:
    """Return an operand of the connective `op` in words.

    An operand that contains `until` or another connective at the top level gets parentheses.
    """
    return say(expr) if isinstance(expr, ast.Logic) and expr.op == op else _inner(expr)


def _compare(expr: ast.Compare) -> str:
    match expr:
        case ast.Compare(operands=(left, right), ops=(op,)) if op in _EQUAL:
            return f"{show_expr(left)} {_EQUAL[op]} {show_expr(right)}"
        case _:
            return show_expr(expr)


def _member(expr: ast.Member) -> str:
    match expr.region:
        case ast.SetLiteral():
            place = f"one of {show_set(expr.region)}"
        case ast.Vector(items=(low, high)):
            place = f"between {show_expr(low)} and {show_expr(high)}"
        case _:
            place = f"in {show_expr(expr.region)}"
    return f"{show_expr(expr.item)} {'is not' if expr.negated else 'is'} {place}"


# --------------------------------------------------------------------------- binders


def _quantifier(expr: ast.Quantifier) -> str:
    every = "every" if expr.kind == "forall" else "some"
    if isinstance(expr.domain, ast.SetLiteral):
        values = show_set(expr.domain)
    else:
        values = " to ".join(map(show_expr, expr.domain))
    return f"for {every} {expr.var} in {values}: {_inner(expr.body)}"


def _freeze(expr: ast.Freeze) -> str:
    names = ", ".join(f"{name} be {show_expr(value)} as it is now" for name, value in expr.bindings)
    return f"let {names}: {_inner(expr.body)}"


_PHRASES: Mapping[type, Callable[[Any], str]] = MappingProxyType(
    {
        **dict.fromkeys((ast.Temporal, ast.Until), _temporal),
        ast.Logic: _logic,
        ast.Not: lambda expr: f"it is not so that {_inner(expr.operand)}",
        ast.Compare: _compare,
        ast.Member: _member,
        ast.Quantifier: _quantifier,
        ast.Freeze: _freeze,
        ast.IfThenElse: lambda expr: (
            f"if {say(expr.cond)}, then {_inner(expr.yes)}, otherwise {_inner(expr.no)}"
        ),
        ast.Call: _call,
        ast.Bool: lambda expr: "nothing is demanded" if expr.value else "nothing can satisfy this",
        ast.Name: lambda expr: f"{expr.name} holds",
    }
)
"""Class of expressions -> function that returns one in words; others are shown in the language."""
