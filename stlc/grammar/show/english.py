"""Requirements as English sentences."""

from __future__ import annotations

from collections import deque
from typing import assert_never

from stlc.grammar import ast
from stlc.grammar.show.printer import show_expr, show_set
from stlc.grammar.traverse import descendants

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
"""Limit in characters on definitions repeated with each requirement that uses them."""


class Meanings:
    """Definitions of a specification in words, each computed once."""

    def __init__(self, spec: ast.Spec) -> None:
        self._known = {entry.name: entry for entry in spec.items if isinstance(entry, _NAMED)}
        self._words: dict[str, str] = {}
        self._uses: dict[str, list[str]] = {}
        self._letters = 0

    def of(self, item: ast.Require | ast.Assume) -> list[tuple[str, str]]:
        """Return the names that a requirement uses, directly or indirectly, each with its meaning.

        If the definitions of a specification exceed `REPEATED` characters, each is given only once.
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

    def _used(self, expr: ast.Expr) -> list[str]:
        names = (node.name for node in descendants(expr) if isinstance(node, ast.Name))
        return list(dict.fromkeys(name for name in names if name in self._known))


def _meaning(entry: ast.Def | ast.Region | ast.Const) -> str:
    if isinstance(entry, ast.Region):
        return show_expr(entry.value)
    if isinstance(entry, ast.Const):
        return show_expr(entry.value) + (f" [{entry.unit}]" if entry.unit else "")
    text = say(entry.value) if _is_formula(entry.value) else show_expr(entry.value)
    names = ", ".join(formal.name for formal in entry.formals)
    return f"of {names}: {text}" if names else text


def _is_formula(expr: ast.Expr) -> bool:
    kinds = ast.Compare | ast.Member | ast.Not | ast.Logic | ast.Temporal | ast.Until | ast.Quantifier
    return isinstance(expr, kinds)


def say(expr: ast.Expr) -> str:
    """Return an expression in words."""
    match expr:
        case ast.Temporal() | ast.Until():
            return _temporal(expr)
        case ast.Logic() | ast.Not():
            return _logic(expr)
        case ast.Compare() | ast.Member():
            return _atom(expr)
        case ast.Quantifier() | ast.Freeze() | ast.IfThenElse():
            return _binder(expr)
        case ast.Call(func=ast.Name(name=name), args=(ast.Arg(value=body),)) if name in _EDGES:
            return _EDGES[name].format(show_expr(body))
        case ast.Bool(value=value):
            return "nothing is demanded" if value else "nothing can satisfy this"
        case ast.Name(name=name):
            return f"{name} holds"
        case _:
            return show_expr(expr)


def _inner(expr: ast.Expr) -> str:
    """Return an expression within a sentence, connectives in parentheses."""
    return f"({say(expr)})" if isinstance(expr, ast.Logic | ast.Until) else say(expr)


# ------------------------------------------------------------------------------ time

_ALWAYS = {"always": "at all times", "historically": "at all times"}
_SOMETIMES = {"eventually": "at some time", "once": "at some time"}


def _temporal(expr: ast.Temporal | ast.Until) -> str:
    when = _when(expr.interval, past=expr.op in ("once", "historically", "since"))
    match expr:
        case ast.Temporal(op=op, body=body):
            return f"{({**_ALWAYS, **_SOMETIMES})[op]} {when}: {_inner(body)}"
        case ast.Until(op=op, left=left, right=right):
            one, other = _inner(left), _inner(right)
            match op:
                case "until":
                    return f"{one}, until {other}, which happens at some time {when}"
                case "unless":
                    return f"{one}, until {other}; that need not happen {when}"
                case "release":
                    return f"{other} at all times {when}, up to and with the time when {one}"
                case "since":
                    return f"{other} at some time {when}, and from then on {one}"
                case _:
                    assert_never(op)
        case _:
            assert_never(expr)


def _when(interval: ast.Interval | None, *, past: bool) -> str:
    """Return the window of a temporal operator in words."""
    if interval is None:
        return "so far" if past else "from now on"
    low, high = show_expr(interval.lo), show_expr(interval.hi)
    edge = " (" + " and ".join(_ends(interval)) + " excluded)" if interval.lo_open or interval.hi_open else ""
    if interval.clock == "start":
        return f"between {low} and {high} of the mission{edge}"
    if high in ("end", "inf"):
        start = "from now" if low in ("0", "0 s") else f"from {low} from now"
        return f"so far{edge}" if past else f"{start} on{edge}"
    if low in ("0", "0 s", "0 steps"):
        return f"in the {'last' if past else 'next'} {high}{edge}"
    return f"between {low} and {high} {'ago' if past else 'from now'}{edge}"


def _ends(interval: ast.Interval) -> list[str]:
    return [*(["the start"] if interval.lo_open else []), *(["the end"] if interval.hi_open else [])]


# ----------------------------------------------------------------------------- logic


def _logic(expr: ast.Logic | ast.Not) -> str:
    match expr:
        case ast.Not(operand=operand):
            return f"it is not so that {_inner(operand)}"
        case ast.Logic(op=op, left=left, right=right):
            if op == "->":
                return f"if {say(left)}, then {say(right)}"
            one, other = _side(left, op), _side(right, op)
            match op:
                case "and" | "or":
                    return f"{one}, {op} {other}" if "," in one or ":" in one else f"{one} {op} {other}"
                case "xor":
                    return f"either {one} or {other}, not both"
                case "<->":
                    return f"{one} exactly when {other}"
                case _:
                    assert_never(op)
        case _:
            assert_never(expr)


def _side(expr: ast.Expr, op: str) -> str:
    """Return an operand; one with the same connective needs no parentheses."""
    return say(expr) if isinstance(expr, ast.Logic) and expr.op == op else _inner(expr)


def _atom(expr: ast.Compare | ast.Member) -> str:
    match expr:
        case ast.Compare(operands=(left, right), ops=(op,)) if op in _EQUAL:
            return f"{show_expr(left)} {_EQUAL[op]} {show_expr(right)}"
        case ast.Compare():
            return show_expr(expr)
        case ast.Member(item=item, region=region, negated=negated):
            verb = "is not" if negated else "is"
            match region:
                case ast.SetLiteral():
                    place = f"one of {show_set(region)}"
                case ast.Vector(items=(low, high)):
                    place = f"between {show_expr(low)} and {show_expr(high)}"
                case _:
                    place = f"in {show_expr(region)}"
            return f"{show_expr(item)} {verb} {place}"
        case _:
            assert_never(expr)


def _binder(expr: ast.Quantifier | ast.Freeze | ast.IfThenElse) -> str:
    match expr:
        case ast.Quantifier(kind=kind, var=var, domain=domain, body=body):
            every = "every" if kind == "forall" else "some"
            if isinstance(domain, ast.SetLiteral):
                values = show_set(domain)
            else:
                values = f"{show_expr(domain[0])} to {show_expr(domain[1])}"
            return f"for {every} {var} in {values}: {_inner(body)}"
        case ast.Freeze(bindings=bindings, body=body):
            names = ", ".join(f"{name} be {show_expr(value)} as it is now" for name, value in bindings)
            return f"let {names}: {_inner(body)}"
        case ast.IfThenElse(cond=cond, yes=yes, no=no):
            return f"if {say(cond)}, then {_inner(yes)}, otherwise {_inner(no)}"
        case _:
            assert_never(expr)
