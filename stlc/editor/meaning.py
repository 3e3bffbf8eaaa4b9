"""What names and intervals of a specification come to, as far as that can be said of an unfinished text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace

from stlc.compile.frontend.declare import ranged
from stlc.compile.frontend.evaluate import evaluate
from stlc.compile.frontend.expressions import resolve_formula
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.modules import Module
from stlc.compile.frontend.resolve import declared
from stlc.compile.frontend.scope import Definition, Failed, Known, Scope
from stlc.compile.frontend.values import Value
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid, to_window
from stlc.compile.ir.nodes import Window
from stlc.compile.ir.support import reach
from stlc.compile.lowering.lower import lower
from stlc.compile.lowering.simplify import simplify
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.signature import Column
from stlc.source import Span
from stlc.units import Unit

_OUTWARD = ("always", "historically", "release")


@dataclass(frozen=True, slots=True)
class Meaning:
    """A specification as far as it can be understood.

    Attributes:
        scope: the names of the file.
        columns: signals and parameters by the name of their declaration, with their ranges.
        formulas: requirements and assumptions, and definitions without arguments that are formulas.
        grid: of the system; empty where there is none.
        interface: of the system, if there is one.
    """

    scope: Scope
    columns: Mapping[str, tuple[Column, ...]]
    formulas: Mapping[str, typed.Formula]
    grid: Grid
    interface: Interface | None = field(default=None, repr=False)

    def value(self, name: str) -> Value | None:
        """What a signal, constant, region or definition without arguments is; None where that fails."""
        entry = self.scope.entries.get(name)
        if isinstance(entry, Known):
            return entry.value
        if not isinstance(entry, Definition) or entry.formals or entry.span is None:
            return None
        try:
            with self.scope.meter.fresh():
                return evaluate(ast.Name(entry.span, name, quoted=True), self.scope)
        except Failed:
            return None

    def steps(self, name: str) -> int | None:
        """How many steps ahead a formula looks; None where the grid does not say."""
        formula = self.formulas.get(name)
        if formula is None:
            return None
        sink: list[Diagnostic] = []
        lowered = lower(formula, self.grid, sink)
        if any(finding.severity == "error" for finding in sink):
            return None
        return reach(simplify(lowered)).future

    def interval(self, span: Span) -> tuple[typed.Interval, Window | None] | None:
        """The interval that is written at `span`, and its window in steps where the grid is known."""
        for formula in self.formulas.values():
            for node in _temporal(formula):
                if node.interval.span == span:
                    return node.interval, self._window(node)
        return None

    def _window(self, node: typed.Temporal | typed.Until) -> Window | None:
        sink: list[Diagnostic] = []
        window = to_window(node.interval, self.grid, sink, outward=node.op in _OUTWARD)
        return None if any(finding.severity == "error" for finding in sink) else window


def understand(
    spec: ast.Spec, modules: tuple[Module, ...], *, interface: Interface | None, grid: Grid
) -> Meaning:
    """What can be understood of a specification; findings are dropped, the compiler reports them."""
    scope = Scope(temporal=True, time_unit=spec.time_unit)
    file = declared(spec, modules, interface, {}, scope)
    columns = {decl.name: _ranged(decl, plain, unit, file.scope) for decl, plain, unit in file.found.columns}
    meaning = Meaning(file.scope, columns, {}, grid, interface)
    return replace(meaning, formulas=_formulas(spec, meaning))


def _ranged(
    decl: ast.Signal | ast.Param, plain: tuple[Column, ...], unit: Unit, scope: Scope
) -> tuple[Column, ...]:
    try:
        return ranged(plain, unit, decl, scope)
    except Failed:
        return plain


def _formulas(spec: ast.Spec, meaning: Meaning) -> dict[str, typed.Formula]:
    """By name; a requirement wins over a definition of the same name."""
    found: dict[str, typed.Formula] = {}
    for item in spec.items:
        if isinstance(item, ast.Def):
            value = meaning.value(item.name)
            if isinstance(value, typed.Node):
                found[item.name] = value
    for item in spec.items:
        if isinstance(item, ast.Require | ast.Assume):
            try:
                found[item.name] = resolve_formula(item.formula, meaning.scope)
            except Failed:
                continue
    return found


def _temporal(formula: object) -> Iterator[typed.Temporal | typed.Until]:
    """Every temporal operator of a formula."""
    if isinstance(formula, tuple):
        for part in formula:
            yield from _temporal(part)
    elif isinstance(formula, typed.Node):
        if isinstance(formula, typed.Temporal | typed.Until):
            yield formula
        for one in fields(formula):
            if one.name not in ("span", "interval", "num"):
                yield from _temporal(getattr(formula, one.name))
