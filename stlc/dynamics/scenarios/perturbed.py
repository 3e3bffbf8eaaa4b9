"""Parametric uncertainty: a factor for every uncertain number of the dynamics, and the perturbed system.

`test: {uncertain: […]}` lists the uncertain constants. Without this list, all constants and literals in the
arithmetic of `flow` and of the resets of jumps are uncertain, with two exceptions. A constant that a
condition reads is exact: it is a place or a time (where a station is, when a light changes), not a property
of the plant. A constant or literal in an exponent, an index or an argument of a function is exact, because it
belongs to the mathematics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, repeat
from typing import TYPE_CHECKING, Any

from stlc.compile.frontend.scope import Definition, Known
from stlc.compile.frontend.values import Number
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.load import moving_parts
from stlc.dynamics.declaration.motion import Assign, JumpDecl, each_jump, read_flow
from stlc.dynamics.model.algebra import multiply, names_in
from stlc.dynamics.model.system import System
from stlc.dynamics.schema.names import Names, base_name, each_number
from stlc.dynamics.schema.reader import Reader
from stlc.grammar import ast
from stlc.grammar.traverse import children, descendants
from stlc.units import SYMBOLS

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.dynamics.model.rollout import Columns


@dataclass(frozen=True, slots=True)
class Uncertain:
    """An uncertain number of the dynamics.

    Attributes:
        factor: name of the column by which the number is multiplied; it is 1 in the model.
        text: source text of the number, such as `vy` or `0.01 m/rad`.
        states: names of the states whose equations or resets read the number.
    """

    factor: str
    text: str
    states: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.text} (of {', '.join(self.states)})"


@dataclass(frozen=True, slots=True)
class Perturbable:
    """Declaration of a system in which every uncertain number of the dynamics is multiplied by a factor.

    Attributes:
        decl: the declaration; the factors are columns that `flow` and `jumps` read.
        numbers: the uncertain numbers.
    """

    decl: SystemDecl
    numbers: tuple[Uncertain, ...]


def perturbable(decl: SystemDecl) -> Perturbable:
    """Multiply each uncertain number of a declaration's dynamics by a factor; return the result."""
    parts = moving_parts(decl)
    names = parts.cx.names
    used, listed = _UsedNumbers(names), decl.test.uncertain

    def read(rewriting: Names) -> tuple[tuple[Assign, ...], tuple[JumpDecl | None, ...]]:
        cx = replace(parts.cx, reader=Reader(decl.source), names=rewriting).plain  # its findings are dropped
        return read_flow(parts.flow, cx), each_jump(parts.jump, cx)

    read(replace(names, rewrite=used.record))
    chosen = used.computed_with - used.compared if listed is None else frozenset(listed)
    texts = {_factor(name): name for name in sorted(chosen)}
    if listed is None:
        texts |= {_place(each): each.span.text for each in used.literals.values()}
    rewriting = replace(
        names, entries=dict(names.entries), rewrite=used.rewritten if listed is None else None
    )
    for name in chosen:
        scaled = partial(_scaled, factor=ir.Signal(_factor(name)))
        rewriting.entries[name] = each_number(names.entries[name], scaled)
    for factor in texts:
        rewriting.entries[factor] = Known(Number(ir.Signal(factor), flexible=True, bare=True))
    factored = _laid_over(decl, *read(rewriting))
    found = (Uncertain(factor, text, _readers(factored, factor)) for factor, text in texts.items())
    return Perturbable(factored, tuple(each for each in found if each.states))


def _laid_over(decl: SystemDecl, flow: tuple[Assign, ...], jumps: tuple[JumpDecl | None, ...]) -> SystemDecl:
    """Return the declaration with the guards, equations and resets of `flow` and `jumps`.

    `jumps` are the first ones of the declaration, in its order; those of timers follow them and stay. Bool
    and enum states keep their equations and resets.
    """
    real = {column.name for column in decl.signature.columns if column.kind == "real"}

    def replaced(assigns: tuple[Assign, ...], others: tuple[Assign, ...]) -> tuple[Assign, ...]:
        values = {assign.name: assign for assign in others if assign.name in real}
        return tuple(values.get(assign.name, assign) for assign in assigns)

    changed = (
        jump
        if other is None
        else replace(jump, guard=other.guard, resets=replaced(jump.resets, other.resets))
        for jump, other in zip(decl.jumps, chain(jumps, repeat(None)), strict=False)
    )
    return replace(decl, flow=replaced(decl.flow, flow), jumps=tuple(changed))


def _readers(decl: SystemDecl, factor: str) -> tuple[str, ...]:
    """Return the names of the states whose next value depends on the column `factor`.

    Either the equation of such a state reads the column, or a jump that sets the state reads it, in its guard
    or its reset.
    """
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


def _scaled(number: Number, factor: ir.Num) -> Number:
    """Multiply a number by a factor; one on a scale such as degC has no relative error and stays as it is."""
    if number.unit.offset:
        return number
    return replace(number, num=multiply(number.num, factor), exact=None)


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


class _UsedNumbers:
    """Collector of the numbers in the arithmetic of expressions, and of the constants in conditions.

    Attributes:
        names: declared names of the system file.
        constants: names of the constants.
        computed_with: constants found as operands of arithmetic.
        compared: constants found in conditions, exponents and indices; they count as exact.
        literals: name of a factor -> the literal (number in the source) that it multiplies.
    """

    def __init__(self, names: Names) -> None:
        self.names = names
        self.constants = frozenset(map(base_name, names.constants))
        self.computed_with: set[str] = set()
        self.compared: set[str] = set()
        self.literals: dict[str, ast.Quantity] = {}

    def record(self, expr: ast.Expr) -> ast.Expr:
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
                if called or not value or _is_point(node):
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
        for part in children(node):
            if id(part) not in done:
                self._compare(part)
        return replace(node, **changed)

    def _compare(self, part: ast.Node) -> None:
        """Record the constants in `part`, a condition, an exponent or an index; they count as exact."""
        for node in descendants(part):
            if isinstance(node, ast.Name):
                found = self.names.entries.get(node.name)
                self.compared |= {node.name} & self.constants
                if isinstance(found, Definition):
                    self._compare(found.body)


# -------------------------------------------------------------------------- the perturbed system


class PerturbedSystem(System):
    """True dynamics of several agents, each with its own factors; all agents are stepped in one batch.

    Args:
        factored: dynamics in which every uncertain number is multiplied by a factor.
        factors: values of the factors, (agents, uncertain numbers); 1 for a number without error.
    """

    def __init__(self, factored: Perturbable, factors: Tensor) -> None:
        super().__init__(factored.decl)
        self._factors = {each.factor: factors[:, index] for index, each in enumerate(factored.numbers)}

    def _inputs(self, u: Tensor) -> Columns:
        """Return the controls and the factors of the uncertain numbers as columns by name."""
        return {**super()._inputs(u), **{name: factor.to(u) for name, factor in self._factors.items()}}
