"""Expressions in a system file: parsing with source locations, and resolution of names and units."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TypeVar

from stlc.compile.frontend.arithmetic import difference_for_point, point_for_amount
from stlc.compile.frontend.expressions import (
    resolve_number,
    resolve_numbers,
    resolve_region,
    resolve_state_formula,
    stored,
)
from stlc.compile.frontend.scope import Entry, Scope
from stlc.compile.frontend.values import Number
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Diagnostic, StlcError
from stlc.dynamics.declaration.schema.reader import Reader, first_line
from stlc.dynamics.declaration.schema.yaml_nodes import Node, Scalar
from stlc.dynamics.declaration.schema.yaml_nodes import Sequence as ListNode
from stlc.grammar import ast
from stlc.grammar.parser import parse_expr
from stlc.source import Span
from stlc.units import Unit

_T = TypeVar("_T", bound="Number | tuple[Number, ...] | ir.Formula")
SECOND = Unit.parse("s")
MAX_STEPS = 100_000
_ATTRIBUTE = re.compile(r"(?<=[\w)\]\"'])(?<!\d)\.\s*([A-Za-z_]\w*)")
_NOT_FINITE = frozenset(
    {".nan", ".NaN", ".NAN", "nan", "NaN", ".inf", "-.inf", ".Inf", "-.Inf", "inf", "-inf"}
)
_SORTS = {"E201": "S203", "E202": "S203"}
_SORTS_DIFFER = frozenset({"E201", "E202", "E205"})


@dataclass(frozen=True, slots=True)
class Expressions:
    """Compiler of the expressions in a section of a system file.

    Attributes:
        reader: collects the findings.
        scope: table of the names that expressions may use.
        ready: names of the states, parameters and local names that already have a value. An expression that
            reads any other of these names is reported as an error (S202). If None, all of them have a value.
        amounts: whether the numbers are added to states, as in a disturbance. If so, 5 degC is a temperature
            difference, otherwise a temperature.
        rewrite: function applied to every parsed expression before its names are resolved; None changes
            nothing.
    """

    reader: Reader
    scope: Scope
    ready: frozenset[str] | None = None
    amounts: bool = False
    rewrite: Callable[[ast.Expr], ast.Expr] | None = None

    def extended(
        self, entries: Mapping[str, Entry], *, samplers: bool = False, ready: frozenset[str] | None = None
    ) -> Expressions:
        """Return a compiler that also knows the names in `entries`.

        If `samplers`, functions such as `uniform` are known, too. `ready` are the names of the states,
        parameters and local names that already have a value; None means all.
        """
        return replace(self, scope=self.scope.extended(entries, samplers=samplers), ready=ready)

    # ------------------------------------------------------------------ parsing

    def parse(self, node: Node | None, where: str) -> ast.Expr | None:
        """Parse the expression in a field; `where` names the field in messages. None if it is invalid."""
        if not isinstance(node, Scalar) or node.is_null:
            if node is not None:
                self.reader.wrong(node, where, "an expression")
            return None
        if node.text in _NOT_FINITE and node.style == "plain":
            self.reader.wrong(node, where, "a finite number", "write a value, or leave the key out")
            return None
        span = node.inside
        if node.escaped:
            self.reader.report("S201", "an expression has no escapes", span, "write it without quotes")
            return None
        attribute = _ATTRIBUTE.search(span.text)
        if attribute:
            start = span.start
            self.reader.add(
                Diagnostic(
                    "S201",
                    "attributes and their calls are not part of the expression language",
                    Span(span.source, start + attribute.start(1), start + attribute.end(1)),
                    note=("expressions are parsed, never evaluated as Python",),
                )
            )
            return None
        try:
            expr = parse_expr(span.source, span.start, span.end)
        except StlcError as error:
            self.reader.add(*(replace(finding, code="S201") for finding in error.diagnostics))
            return None
        return expr if self.rewrite is None else self.rewrite(expr)

    # -------------------------------------------------------------------- typing

    def number(self, node: Node | None, where: str) -> Number | None:
        """Read a number and scale it to SI units; return None if the number is invalid.

        The zero of a temperature scale is not shifted: 20 degC becomes 20, not 293.15. `where` names the
        number in messages.
        """
        expr = self.parse(node, where)
        return None if expr is None else self._typed(resolve_number, expr)

    def numbers(self, node: Node | None, where: str) -> tuple[Number, ...] | None:
        """Read a number or a vector, written as one expression or as a list; return the components.

        The components are scaled to SI units. Returns None if a component is invalid. `where` names the value
        in messages.
        """
        if isinstance(node, ListNode):
            each = [self.number(item, f"a component of {where}") for item in self.reader.items(node, where)]
            found = tuple(number for number in each if number is not None)
            return found if found and len(found) == len(each) else None
        expr = self.parse(node, where)
        return None if expr is None else self._typed(resolve_numbers, expr)

    def formula(self, node: Node | None, where: str) -> ir.Formula | None:
        """Read a state formula; return None if it is invalid. `where` names the formula in messages."""
        expr = self.parse(node, where)
        return None if expr is None else self.formula_of(expr)

    def formula_of(self, expr: ast.Expr) -> ir.Formula | None:
        """Return `expr` as a state formula; report an error and return None if it is not a formula."""
        return self._typed(resolve_state_formula, expr)

    def check(self, expr: ast.Expr) -> None:
        """Report errors in an expression, whether it is a number, a vector or a formula."""
        rejected: list[list[Diagnostic]] = []
        resolvers: tuple[Callable[[ast.Expr, Scope], object], ...] = (
            resolve_numbers,
            resolve_state_formula,
            resolve_region,
        )
        for resolve in resolvers:
            sink: list[Diagnostic] = []
            try:
                resolve(expr, replace(self.scope, sink=sink, cache={}))
                return
            except StlcError as error:
                rejected.append([*sink, *(f for f in error.diagnostics if f not in sink)])
        for findings in rejected:
            inner = [f for f in findings if f.code not in _SORTS_DIFFER or f.span != expr.span]
            if inner:
                self._report(inner)
                return

    def _typed(self, resolve: Callable[[ast.Expr, Scope], _T], expr: ast.Expr) -> _T | None:
        """Apply `resolve`, which determines names, types and units of an expression; return its result.

        Returns None if `resolve` reports an error. If the expression reads a name that has no value yet (see
        `ready`), the error S202 is reported, and None is returned, too.
        """
        sink: list[Diagnostic] = []
        try:
            found = resolve(expr, replace(self.scope, sink=sink))
        except StlcError as error:
            sink.extend(finding for finding in error.diagnostics if finding not in sink)
            return None
        finally:
            self._report(sink)
        early = sorted(_columns(found) - self.ready) if self.ready is not None else []
        if early:
            listed = ", ".join(f"`{name}`" for name in early)
            self.reader.report("S202", f"{listed} has no value yet", expr.span, "draw it on an earlier line")
            return None
        return found

    def _report(self, findings: Sequence[Diagnostic]) -> None:
        """Report findings of the compiler, with the error codes of system files, not of specifications."""
        self.reader.add(*(replace(f, code=_SORTS.get(f.code, f.code)) for f in findings))

    # --------------------------------------------------------------------- values

    def stored(self, node: Node | None, where: str, unit: Unit) -> ir.Num | None:
        """Read a number and convert it to `unit`, the unit of the column in which it is stored.

        Returns None if the value is invalid. `where` names the value in messages.
        """
        number = self.number(node, where)
        if number is None or node is None:
            return None
        return self._in_unit(number, node, where, unit)

    def stored_each(self, node: Node, where: str, unit: Unit, size: int) -> tuple[ir.Num, ...] | None:
        """Read a vector of length `size`; return its components, converted to `unit`.

        A single number is repeated for all components. If it is random, it is drawn separately for each
        component. Returns None if the value is invalid. `where` names it in messages.
        """
        numbers = self.numbers(node, where)
        if numbers is None:
            return None
        if len(numbers) == 1 and size > 1 and isinstance(node, Scalar):
            again = [self.number(node, where) for _ in range(size)]
            numbers = tuple(number for number in again if number is not None)
        if len(numbers) != size:
            message = f"{where} has {size} components, this has {len(numbers)}"
            self.reader.report("S203", message, first_line(node.span))
            return None
        found = [self._in_unit(number, node, where, unit) for number in numbers]
        kept = tuple(value for value in found if value is not None)
        return kept if len(kept) == size else None

    def _in_unit(self, number: Number, node: Node, where: str, unit: Unit) -> ir.Num | None:
        """Convert a number to `unit`, the unit of the column in which it is stored.

        Reports and returns None if the dimensions differ (E203), or if a temperature is mixed up with a
        temperature difference. `where` names the number in messages.
        """
        if self._fits(number, unit):
            place = first_line(node.span)
            if not unit.text and not number.flexible and not number.unit.dimensionless:
                message = (
                    f"{where} is in [{number.unit}], and no unit is declared that it could be checked with"
                )
                self._report((Diagnostic("W108", message, place, help=("declare it: `unit: …`",)),))
            if self.amounts and number.unit.offset:
                self._report((point_for_amount(where, number, place),))
                return None
            unit = unit.interval if self.amounts else unit
            if unit.offset and number.sense == "difference":
                self._report((difference_for_point(number, unit, place),))
                return None
            return (
                number.num if number.bare else stored(number, unit)
            )  # a bare number is in the column's unit
        message = f"{where} is in [{unit}], this is in [{number.unit}]"
        self.reader.report("E203", message, first_line(node.span), label=f"[{number.unit}]")
        return None

    def truth(self, node: Node | None, where: str) -> ir.Num | None:
        """Read a number or a formula as the value of a bool column: an expression with the value 0 or 1.

        Returns None if the value is invalid. `where` names the value in messages.
        """
        expr = self.parse(node, where)
        match expr:
            case None:
                return None
            case ast.Bool(_, value):
                return ir.Const(float(value))
            case _ if expr.is_formula:
                formula = self.formula_of(expr)
                return None if formula is None else formula.indicator()
            case _:
                return self.stored(node, where, Unit())

    def constant(self, node: Node | None, where: str, unit: Unit) -> float | None:
        """Read a constant known at compile time, and convert it to `unit`, the unit of its column.

        Returns None if the value is invalid. `where` names the value in messages.
        """
        value = self.stored(node, where, unit)
        found = None if value is None or node is None else self._constants((value,), node, where)
        return None if found is None else found[0]

    def constants(self, node: Node, where: str, unit: Unit, size: int) -> tuple[float, ...] | None:
        """Read `size` constants known at compile time, and convert them to `unit`, the unit of their columns.

        Returns None if any of them is invalid. `where` names them in messages.
        """
        values = self.stored_each(node, where, unit, size)
        return None if values is None else self._constants(values, node, where)

    def _constants(self, values: tuple[ir.Num, ...], node: Node, where: str) -> tuple[float, ...] | None:
        """Return the values of constant expressions; report any that is not constant, and return None.

        `where` names them in messages, which are located at `node`.
        """
        found = tuple(value.value for value in values if isinstance(value, ir.Const))
        if len(found) < len(values):
            self.reader.wrong(node, where, "a constant", "use numbers and the names under `const`")
            return None
        return found

    def duration(self, node: Node | None, where: str) -> Fraction | None:
        """Read an exact duration in seconds; a number without unit is in seconds.

        Returns None if the value is invalid. `where` names the value in messages.
        """
        number = self.number(node, where)
        if number is None or node is None:
            return None
        if number.exact is None or not self._fits(number, SECOND) or number.exact <= 0:
            self.reader.wrong(node, where, "a positive time", "for example `0.1 s`")
            return None
        return number.exact

    def steps(self, node: Node | None, where: str, dt: Fraction) -> int | None:
        """Read a number of steps: `25 steps`, `25`, or a time that is a multiple of the time step `dt`.

        Returns None if the value is invalid. `where` names the value in messages.
        """
        if node is None:
            return None
        expr = self.parse(node, where)
        match expr:
            case None:
                return None
            case ast.Quantity(_, value, unit) if unit in ("", "steps", "step"):
                count = value
            case _:
                seconds = self.duration(node, where)
                if seconds is None:
                    return None
                count = seconds / dt
        if count > MAX_STEPS:
            self.reader.wrong(node, where, f"at most {MAX_STEPS} steps")
            return None
        if count.denominator != 1 or count < 1:
            self.reader.wrong(
                node,
                where,
                "a positive whole number of steps",
                f"one step is {float(dt):g} s: give a multiple of it, or a number of steps",
            )
            return None
        return int(count)

    @staticmethod
    def _fits(number: Number, unit: Unit) -> bool:
        """True if a number may be stored in a column of `unit`; an undeclared unit accepts anything."""
        return number.flexible or number.bare or not unit.text or number.unit.same_dims(unit)


def _columns(found: Number | tuple[Number, ...] | ir.Formula) -> frozenset[str]:
    """Names of the columns that a number, several numbers or a formula read."""
    if isinstance(found, tuple):
        return frozenset().union(*map(_columns, found))
    return (found.num if isinstance(found, Number) else found).columns


def written(node: Node | None) -> str:
    """Source text of a field, joined to one line, for tables."""
    return " ".join(node.text.split()) if isinstance(node, Scalar) else ""
