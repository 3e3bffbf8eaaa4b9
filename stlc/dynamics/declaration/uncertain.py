"""The uncertain numbers of a system: constants and literals of the dynamics that may be wrong.

`test: {uncertain: […]}` lists the uncertain constants. They are off wherever the dynamics read them: in
`flow`, guards, resets, timers, values of tables, held values and delays. Where an error cannot be carried
(the time step, limits, points of a table, initial states, …), such a constant is refused (S212).

Without this list, all constants and literals in the arithmetic of `flow`, resets, held values, delays, and
values of tables are uncertain, with two exceptions. A constant that a condition, a limit, a time or the
points of a table read is exact: it is a place or a time (where a station is, when a light changes), not a
property of the plant. A constant or literal in an exponent, or a literal in an index or in an argument of a
function is exact, because it belongs to the mathematics.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from stlc.compile.frontend.scope import Definition
from stlc.diagnostics import StlcError, SystemFileError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.schema.names import Names, NumberChanges, base_name
from stlc.dynamics.declaration.schema.yaml_nodes import Mapping as MappingNode
from stlc.dynamics.declaration.schema.yaml_nodes import Node, Scalar
from stlc.dynamics.declaration.schema.yaml_nodes import Sequence as ListNode
from stlc.dynamics.declaration.sections import SystemKeys, motion_of
from stlc.grammar import ast
from stlc.grammar.parser import parse_expr
from stlc.source import Source, Span
from stlc.units import Unit

_NAME = re.compile(r"(?<![\w.])[^\W\d]\w*")
_WORDS = frozenset({"name", "unit", "enum", "squash", "interpolate", "times"})
"""Keys whose values are words, not expressions."""


@dataclass(frozen=True, slots=True)
class UncertainNumbers:
    """The uncertain numbers of a system, and what counts as exact.

    Attributes:
        constants: names of the uncertain constants, in order.
        literals: name of a factor -> source text of the literal that it multiplies.
        exact: names of the constants that the dynamics read and that count as exact.
    """

    constants: tuple[str, ...]
    literals: Mapping[str, str]
    exact: tuple[str, ...] = ()


def uncertain_numbers(decl: SystemDecl, found: SystemKeys) -> UncertainNumbers:
    """Return the uncertain numbers of a system, whose sections are `found`.

    Raises:
        SystemFileError: S212, an error of a number cannot be carried to a place where it stands.
    """
    listed, reads = decl.test.uncertain, {name: _names_in(value) for name, value in _items(found.const)}
    if listed is not None:
        _require_carried(found, decl, listed, reads)
        return UncertainNumbers(tuple(sorted(set(listed))), {})
    names = Names(changes=NumberChanges(lambda _, entry: entry))
    used = NumbersInUse(names, frozenset(map(base_name, decl.constants)))
    changes = NumberChanges(lambda _, entry: entry, used.recorded)
    names.changes = changes
    delays = motion_of(found, decl, names).delays
    share = 0.0 if decl.scenario is None else decl.scenario.errors.parameters
    for delay in delays:
        if delay.keys.at_most is None and share * delay.steps > 1.0 - 1e-9:
            what = f"the delay `{delay.entry.key.text}` of {delay.steps} steps"
            advice = f"`at_most` makes it vary; or list what may be off, without {what}"
            raise _refused(what, "a fixed delay is a number of steps", delay.entry.place("by"), advice)
    timers = [entry.get(key) for _, entry in _entries(found.state) for key in ("run", "reset_when", "to")]
    compared = used.compared.union(*(_names_in(node) for node in timers if node is not None))
    fixed = compared.union(*(_names_in(place.node) for place in _fixed_places(found)))
    exact, computed = _with_sources(fixed & used.constants, reads), _with_sources(used.computed_with, reads)
    literals = {place: node.span.text for place, node in used.literals.items()}
    read = computed | compared & used.constants
    return UncertainNumbers(tuple(sorted(computed - exact)), literals, tuple(sorted(read & exact)))


def _require_carried(
    found: SystemKeys, decl: SystemDecl, listed: Iterable[str], reads: Mapping[str, frozenset[str]]
) -> None:
    """Refuse listed constants that stand where an error of theirs cannot be carried.

    Raises:
        SystemFileError: S212.
    """
    places = (*_fixed_places(found), *_drawn_places(found, decl))
    for name in listed:
        follow = {other for other in reads if name in _with_sources({other}, reads)} | {name}
        for place in places:
            for scalar in _scalars(place.node):
                if follow & _names_in(scalar):
                    advice = "write the number there, or under another name that is not in `uncertain`"
                    raise _refused(f"`{name}`", f"it stands in {place.what}", scalar.span, advice)


def _refused(what: str, why: str, span: Span, advice: str) -> SystemFileError:
    message = f"{what} may be off, which cannot be simulated or bounded: {why}"
    return SystemFileError.of("S212", message, span, "read here", help=(advice,))


# ------------------------------------------------------------------------------ places in the file


@dataclass(frozen=True, slots=True)
class _Place:
    """Part of a system file.

    Attributes:
        node: its values.
        what: description for messages.
    """

    node: Node
    what: str


def _fixed_places(found: SystemKeys) -> Iterator[_Place]:
    """Yield the places of numbers that the model, its columns or its planner need as constants."""
    for section, node in (("time", found.time), ("inputs", found.inputs), ("control", found.control)):
        if node is not None:
            yield _Place(node, f"`{section}`")
    for section, held, keys in (
        ("state", found.state, ("range",)),
        ("param", found.param, ("range",)),
        ("held", found.held, ("every",)),
        ("delay", found.delay, ("at_most", "by")),
        ("table", found.table, ("at",)),
    ):
        for name, entry in _entries(held):
            for key in keys:
                node, clamp, most = (entry.get(each) for each in (key, "clamp", "at_most"))
                free = section == "state" and not (isinstance(clamp, Scalar) and clamp.boolean)
                if node is not None and not free and not (key == "by" and most is not None):
                    yield _Place(node, f"`{key}` of `{name}`")


def _drawn_places(found: SystemKeys, decl: SystemDecl) -> Iterator[_Place]:
    """Yield the places of numbers from which states are drawn, or by which they are changed from outside."""
    if found.init is not None:
        yield _Place(found.init, "`init`, from which the model draws starts")
    for name, entry in _items(found.param):
        draw = entry.get("draw") if isinstance(entry, MappingNode) else entry
        if draw is not None:
            yield _Place(draw, f"the distribution of `{name}`")
    tests = [found.test] if isinstance(found.test, MappingNode) else []
    scenarios = [
        entry for name, entry in _entries(found.scenario) if decl.scenario and name == decl.scenario.name
    ]
    for section in (*tests, *scenarios):
        for key in ("events", "disturb", "noise", "override"):
            if (node := section.get(key)) is not None:
                yield _Place(node, f"`{key}`")


def _items(node: Node | None) -> Iterator[tuple[str, Node]]:
    for entry in node.entries if isinstance(node, MappingNode) else ():
        yield entry.key.text, entry.value


def _entries(node: Node | None) -> Iterator[tuple[str, MappingNode]]:
    for name, value in _items(node):
        if isinstance(value, MappingNode):
            yield name, value


def _scalars(node: Node) -> Iterator[Scalar]:
    match node:
        case MappingNode(entries=entries):
            for entry in entries:
                if entry.key.text not in _WORDS:
                    yield from _scalars(entry.value)
        case ListNode(items=items):
            for item in items:
                yield from _scalars(item)
        case Scalar():
            yield node


def _names_in(node: Node) -> frozenset[str]:
    """Names that the expressions in a node read; those of units are not among them."""
    return frozenset[str]().union(*(_names_read(scalar.text) for scalar in _scalars(node)))


def _names_read(text: str) -> frozenset[str]:
    if not _NAME.search(text):
        return frozenset()
    try:
        expr = parse_expr(Source("", text), 0, len(text))
    except StlcError:  # a word of the format, or text
        return frozenset()
    return frozenset(part.name for part in expr.walk() if isinstance(part, ast.Name))


def _with_sources(names: Iterable[str], reads: Mapping[str, frozenset[str]]) -> frozenset[str]:
    """Return `names` and all constants from which they are computed."""
    found, new = set[str](), set(names)
    while new:
        found |= new
        new = {each for name in new for each in reads.get(name, ()) if each in reads} - found
    return frozenset(found)


# -------------------------------------------------------------------- rewriting of expressions

_COMPUTED: Mapping[type[ast.Node], tuple[str, ...]] = {
    ast.Neg: ("operand",),
    ast.Vector: ("items",),
    ast.Binary: ("left", "right"),
    ast.Index: ("base",),
    ast.IfThenElse: ("yes", "no"),
    ast.Call: ("args",),
    ast.Arg: ("value",),
}
"""Class of an expression -> the fields whose numbers it computes with; those in other fields are exact."""


def _computed(node: ast.Node) -> tuple[str, ...]:
    """Return the names of the fields of a syntax tree node that hold operands of arithmetic.

    Exponents, indices and conditions are not among them.
    """
    match node:
        case ast.Binary(op="%" | "^"):
            return ("left",)
        case ast.Call(func=ast.Name(name="ind")) | ast.Arg(name=str()):
            return ()
        case _:
            return _COMPUTED.get(type(node), ())


def _place(node: ast.Quantity) -> str:
    return f"?{node.span.source.name}:{node.span.start}"


class NumbersInUse:
    """Collector of the numbers in the arithmetic of expressions, and of the constants in conditions.

    Attributes:
        names: declared names of the system file.
        constants: names of the constants.
        computed_with: constants found as operands of arithmetic.
        compared: constants found in conditions, exponents and indices; they count as exact.
        literals: name of a factor -> the literal (number in the source) that it multiplies.
    """

    def __init__(self, names: Names, constants: frozenset[str]) -> None:
        self.names, self.constants = names, constants
        self.computed_with: set[str] = set()
        self.compared: set[str] = set()
        self.literals: dict[str, ast.Quantity] = {}

    def recorded(self, expr: ast.Expr) -> ast.Expr:
        """Record the numbers of an expression and return it unchanged."""
        self.rewritten(expr)
        return expr

    def rewritten(self, node: Any, *, called: bool = False) -> Any:
        """Return an expression with a factor at each literal: `2 * v` becomes `2 * factor * v`.

        Names of definitions are replaced by their expressions. The literals and the constants are recorded.

        Args:
            node: an expression, or an argument of a call.
            called: whether `node` is within a call, where literals are exact and get no factor.
        """
        match node:
            case ast.Quantity(span=span, value=value):
                known = Unit.SYMBOLS.get(node.unit)
                if called or not value or (known is not None and known.offset):
                    return node
                self.literals[_place(node)] = node
                return ast.Binary(span, "*", node, ast.Name(span, _place(node)))
            case ast.Name(name=name):
                found = self.names.entries.get(name)
                if isinstance(found, Definition):
                    return self.rewritten(found.body, called=called)
                self.computed_with |= {name} & self.constants
                return node
        inside, done, changed = called or isinstance(node, ast.Call), set(), {}
        for field in _computed(node):
            value = getattr(node, field)
            parts = value if isinstance(value, tuple) else (value,)
            done |= set(map(id, parts))
            again = tuple(self.rewritten(part, called=inside) for part in parts)
            changed[field] = again if isinstance(value, tuple) else again[0]
        for part in node.children():
            if id(part) not in done:
                self._compare(part)
        return replace(node, **changed)

    def _compare(self, part: ast.Node) -> None:
        """Record the constants in `part`, a condition, an exponent or an index; they count as exact."""
        for node in part.walk():
            if isinstance(node, ast.Name):
                found = self.names.entries.get(node.name)
                self.compared |= {node.name} & self.constants
                if isinstance(found, Definition):
                    self._compare(found.body)
