"""Parametric uncertainty: a factor for every uncertain number of the dynamics, and the perturbed system.

Unless `test: {uncertain: […]}` names them, uncertain numbers are the constants and literals that `flow` and
the resets of jumps compute with. Conditions read positions and instants (where a station is, when a light
changes), which are not properties of the plant; exponents, indices and function arguments are mathematics. So
these numbers, and constants that a condition also reads, are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

from stlc.compile.frontend.scope import Definition, Entry, Known
from stlc.compile.frontend.values import Number, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.load import moving_parts
from stlc.dynamics.declaration.motion import Assign, JumpDecl, read_flow, read_jumps
from stlc.dynamics.model.algebra import multiply, names_in
from stlc.dynamics.model.system import System
from stlc.dynamics.schema.expressions import Expressions
from stlc.dynamics.schema.names import Context, Names, base_name
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Node
from stlc.grammar import ast
from stlc.grammar.traverse import children, descendants
from stlc.units import SYMBOLS

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.dynamics.model.rollout import Columns


@dataclass(frozen=True, slots=True)
class Uncertain:
    """An uncertain number.

    Attributes:
        factor: the column that multiplies it; 1 for the model's value.
        text: as written: `vy`, `0.01 m/rad`.
        states: those whose equations or resets read it.
    """

    factor: str
    text: str
    states: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.text} (of {', '.join(self.states)})"


@dataclass(frozen=True, slots=True)
class Perturbable:
    """Declaration whose `flow` and `jumps` read a factor for each of its uncertain numbers."""

    decl: SystemDecl
    numbers: tuple[Uncertain, ...]


def perturbable(decl: SystemDecl) -> Perturbable:
    """Dynamics of a declaration with a factor at every uncertain number."""
    parts = moving_parts(decl)
    names = parts.names
    used, listed = _UsedNumbers(names), decl.test.uncertain

    def read(rewriting: Names) -> tuple[tuple[Assign, ...], tuple[JumpDecl, ...]]:
        cx = Context.of(Reader(decl.source), rewriting, parts.clock)  # its findings are dropped
        return read_flow(parts.flow, cx), read_jumps(parts.jump, cx)

    read(_RewritingNames.of(names, used.look))
    chosen = used.computed_with - used.compared if listed is None else frozenset(listed)
    texts = {_factor(name): name for name in sorted(chosen)}
    if listed is None:
        texts |= {_place(each): each.span.text for each in used.literals.values()}
    rewriting = _RewritingNames.of(names, used.rewritten if listed is None else _as_it_is)
    for name in chosen:
        rewriting.entries[name] = _times(names.entries[name], ir.Signal(_factor(name)))
    for factor in texts:
        rewriting.entries[factor] = Known(Number(ir.Signal(factor), flexible=True, bare=True))
    loose = _laid_over(decl, *read(rewriting))
    found = (Uncertain(factor, text, _readers(loose, factor)) for factor, text in texts.items())
    return Perturbable(loose, tuple(each for each in found if each.states))


def _laid_over(decl: SystemDecl, flow: tuple[Assign, ...], jumps: tuple[JumpDecl, ...]) -> SystemDecl:
    """The declaration with replaced equations of real states and replaced guards."""
    real = {column.name for column in decl.signature.columns if column.kind == "real"}
    rates = {assign.name: assign for assign in flow if assign.name in real}
    again = {jump.name: jump for jump in jumps}
    return replace(
        decl,
        flow=tuple(rates.get(assign.name, assign) for assign in decl.flow),
        jumps=tuple(_jump(jump, again.get(jump.name, jump), real) for jump in decl.jumps),
    )


def _jump(jump: JumpDecl, again: JumpDecl, real: set[str]) -> JumpDecl:
    values = {assign.name: assign for assign in again.resets if assign.name in real}
    resets = tuple(values.get(assign.name, assign) for assign in jump.resets)
    return replace(jump, guard=again.guard, resets=resets)


def _readers(decl: SystemDecl, factor: str) -> tuple[str, ...]:
    """States whose equations or jumps read a factor."""
    found = [assign.name for assign in decl.flow if factor in names_in(assign.value)]
    for jump in decl.jumps:
        guarded = factor in names_in(jump.guard)
        found += [each.name for each in jump.resets if guarded or factor in names_in(each.value)]
    return tuple(dict.fromkeys(map(base_name, found)))


def _factor(name: str) -> str:
    return f"?{name}"


def _is_point(node: ast.Quantity) -> bool:
    known = SYMBOLS.get(node.unit)
    return known is not None and bool(known.offset)


def _place(node: ast.Quantity) -> str:
    return f"?{node.span.source.name}:{node.span.start}"


def _times(entry: Entry, factor: ir.Num) -> Entry:
    """Constant times a factor, the same for all components of a vector."""
    assert isinstance(entry, Known)
    match entry.value:
        case Number() as number:
            return replace(entry, value=_scaled(number, factor))
        case VectorValue(items=items) as vector:
            return replace(entry, value=replace(vector, items=tuple(_scaled(item, factor) for item in items)))
        case _:
            return entry


def _scaled(number: Number, factor: ir.Num) -> Number:
    """Number times a factor; a point of a scale has no relative error and is unchanged."""
    if number.unit.offset:
        return number
    return replace(number, num=multiply(number.num, factor), exact=None)


# -------------------------------------------------------------------- rewriting of expressions

Rewrite = Callable[[ast.Expr], ast.Expr]


def _as_it_is(expr: ast.Expr) -> ast.Expr:
    return expr


@dataclass
class _RewritingNames(Names):
    """Names whose expressions are rewritten before they are resolved."""

    rewrite: Rewrite = field(default=_as_it_is)

    @classmethod
    def of(cls, names: Names, rewrite: Rewrite) -> _RewritingNames:
        return cls(names.constants, names.columns, names.controls, dict(names.entries), names.places, rewrite)

    def expressions(self, reader: Reader) -> Expressions:
        """Compiler of expressions in which the perturbed names are replaced."""
        return _RewritingExpressions(reader, Names.expressions(self, reader).scope, rewrite=self.rewrite)


@dataclass(frozen=True, slots=True)
class _RewritingExpressions(Expressions):
    rewrite: Rewrite = field(default=_as_it_is)

    def parse(self, node: Node | None, where: str) -> ast.Expr | None:
        """The syntax tree of a field, rewritten."""
        expr = Expressions.parse(self, node, where)
        return None if expr is None else self.rewrite(expr)


class _UsedNumbers:
    """Numbers that expressions compute with, and constants that conditions read."""

    def __init__(self, names: Names) -> None:
        self.names = names
        self.constants = frozenset(map(base_name, names.constants))
        self.computed_with: set[str] = set()
        self.compared: set[str] = set()
        self.literals: dict[str, ast.Quantity] = {}

    def look(self, expr: ast.Expr) -> ast.Expr:
        """Record an expression and return it unchanged."""
        self.rewritten(expr)
        return expr

    def rewritten(self, expr: ast.Expr, *, called: bool = False) -> ast.Expr:
        """Add a factor to each number that an expression computes with; definitions are expanded."""
        match expr:
            case ast.Quantity(span=span, value=value):
                if called or not value or _is_point(expr):
                    return expr
                self.literals[_place(expr)] = expr
                return ast.Binary(span, "*", expr, ast.Name(span, _place(expr)))
            case ast.Name(name=name):
                found = self.names.entries.get(name)
                if isinstance(found, Definition):
                    return self.rewritten(found.body, called=called)
                self.computed_with |= {name} & self.constants
                return expr
        inside, changed = called or isinstance(expr, ast.Call), {}
        for part, computes in _parts(expr):
            if computes:
                changed[id(part)] = self.rewritten(part, called=inside)
            else:
                self._compare(part)
        return _with_parts(expr, changed)

    def _compare(self, part: ast.Node) -> None:
        for node in descendants(part):
            if isinstance(node, ast.Name):
                found = self.names.entries.get(node.name)
                self.compared |= {node.name} & self.constants
                if isinstance(found, Definition):
                    self._compare(found.body)


def _parts(expr: ast.Expr) -> Iterator[tuple[Any, bool]]:
    """Parts of an expression, and whether it computes with them."""
    match expr:
        case ast.Neg(operand=operand):
            yield operand, True
        case ast.Vector(items=items):
            yield from ((item, True) for item in items)
        case ast.Binary(left=left, right=right, op=op):
            yield from ((left, True), (right, op in "+-*/"))
        case ast.Index(base=base, index=index):
            yield from ((base, True), (index, False))
        case ast.IfThenElse(cond=cond, yes=yes, no=no):
            yield from ((cond, False), (yes, True), (no, True))
        case ast.Call(func=ast.Name(name=name), args=args):
            yield from ((arg.value, name != "ind" and arg.name is None) for arg in args)
        case _:
            yield from ((child, False) for child in children(expr))


def _with_parts(expr: ast.Expr, changed: Mapping[int, ast.Expr]) -> ast.Expr:
    """Expression with some of its parts replaced."""

    def put(value: Any) -> Any:
        match value:
            case tuple():
                return tuple(map(put, value))
            case ast.Arg():
                return replace(value, value=put(value.value))
            case _:
                return changed.get(id(value), value)

    return replace(expr, **{each.name: put(getattr(expr, each.name)) for each in fields(expr)})


# -------------------------------------------------------------------------- the perturbed system


class PerturbedSystem(System):
    """True dynamics of some agents, each with its own factors; all are stepped in one batch.

    Args:
        loose: the dynamics, with a factor at every uncertain number.
        factors: (agents, numbers), 1 where a number is exact.
    """

    def __init__(self, loose: Perturbable, factors: Tensor) -> None:
        super().__init__(loose.decl)
        self._factors = {each.factor: factors[:, index] for index, each in enumerate(loose.numbers)}

    def _inputs(self, u: Tensor) -> Columns:
        """Controls, and the factors of uncertain numbers."""
        return {**super()._inputs(u), **{name: factor.to(u) for name, factor in self._factors.items()}}
