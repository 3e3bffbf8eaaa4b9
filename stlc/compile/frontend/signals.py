"""Signals and parameters as columns, and whether the system has them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from stlc.compile.frontend.algebra import in_unit, on_scale
from stlc.compile.frontend.expressions import evaluate_all
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sorts import Need, as_number
from stlc.compile.frontend.values import Moment
from stlc.diagnostics import Diagnostic, Label
from stlc.grammar import ast
from stlc.registry import closest
from stlc.signature import Column, Kind, Role
from stlc.units import CELSIUS, DIMENSIONLESS, Unit, nearest, parse_unit, same_dims

Labels = tuple[tuple[str, float], ...]

MAX_COMPONENTS = 1000
_KINDS: Mapping[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


_TEMPERATURE = re.compile("temp|therm|celsius|heat|cool|oven|ambient", re.IGNORECASE)


def declared_unit(text: str, decl: ast.Declaration, scope: Scope) -> Unit:
    """The unit in the brackets of a declaration. Raises Failed (E203)."""
    if not text:
        return DIMENSIONLESS
    try:
        unit = parse_unit(text)
    except ValueError as error:
        return scope.fail(
            Diagnostic("E203", str(error), decl.name_span, help=("units: m, s, m/s^2, deg, 1, …",))
        )
    if text.strip() == "C" and _TEMPERATURE.search(decl.name_span.text):
        message = f"`{decl.name_span.text}` is declared in coulombs [C]"
        scope.report(Diagnostic("W107", message, decl.name_span, help=(CELSIUS,)))
    return unit


def check_type(type_: ast.TypeRef | None, enums: Mapping[str, Labels], scope: Scope) -> None:
    """Refuse the name of a type that nothing declares (E101), and a size out of bounds (E005)."""
    if type_ is None:
        return
    if type_.name not in _KINDS and type_.name not in enums and type_.name != "formula":
        near = closest(type_.name, (*_KINDS, *enums))
        help_ = (f"did you mean `{near}`?",) if near is not None else ("types: real, int, bool, or an enum",)
        scope.fail(Diagnostic("E101", f"unknown type `{type_.name}`", type_.span, help=help_))
    if type_.size is not None and not 1 <= type_.size <= MAX_COMPONENTS:
        message = f"a vector has between 1 and {MAX_COMPONENTS} components"
        scope.fail(Diagnostic("E005", message, type_.span))


def columns_of(
    decl: ast.Signal | ast.Param, enums: Mapping[str, Labels], interface: Interface | None, scope: Scope
) -> tuple[Column, ...]:
    """The columns of a declaration, ranges not yet known; matched with the system's where there is one.

    Raises:
        Failed: E101 an unknown type, E103 a signal that the system lacks, E104 or E203 one that differs.
    """
    check_type(decl.type, enums, scope)
    name = decl.column or decl.name if isinstance(decl, ast.Signal) else decl.name
    kind_name = "real" if decl.type is None else decl.type.name
    labels = enums.get(kind_name, ())
    role: Role = decl.role or "state" if isinstance(decl, ast.Signal) else "env"
    unit = declared_unit(decl.unit, decl, scope)
    plain = Column(name, unit, _KINDS.get(kind_name, "enum"), role, labels=labels)
    size = None if decl.type is None else decl.type.size
    columns = (plain,) if size is None else tuple(replace(plain, name=f"{name}[{i}]") for i in range(size))
    if interface is None:
        return columns
    return tuple(_matched(column, decl, interface, scope) for column in columns)


def _matched(column: Column, decl: ast.Signal | ast.Param, interface: Interface, scope: Scope) -> Column:
    """The column as the system stores it."""
    if column.name not in interface.signature:
        if isinstance(decl, ast.Param):
            return column
        scope.fail(_absent(column, decl, interface))
    own = interface.signature[column.name]
    place = interface.places.get(column.name)
    labels = () if place is None else (Label(place, "declared here"),)
    if column.unit.text and own.unit.text and not same_dims(column.unit, own.unit):
        message = f"`{column.name}` is in [{column.unit}] here and in [{own.unit}] in {interface.where}"
        scope.fail(Diagnostic("E203", message, decl.name_span, f"[{column.unit}]", labels))
    discrete = ("bool", "enum")
    if column.kind != own.kind and (column.kind in discrete or own.kind in discrete):
        message = f"`{column.name}` is {_sort(column)} here and {_sort(own)} in {interface.where}"
        scope.fail(Diagnostic("E104", message, decl.name_span, _sort(column), labels))
    if column.kind == "enum" and dict(column.labels) != dict(own.labels):
        message = f"the members of `{column.name}` differ between here and {interface.where}"
        note = (f"here: {_members(column.labels)}", f"{interface.where}: {_members(own.labels)}")
        scope.fail(Diagnostic("E104", message, decl.name_span, labels=labels, note=note))
    unit = own.unit if own.unit.text else column.unit
    return replace(column, unit=unit, low=own.low, high=own.high, fact=own.fact)


def _sort(column: Column) -> str:
    return {"real": "a real number", "int": "a whole number", "bool": "a bool", "enum": "an enum"}[
        column.kind
    ]


def _members(labels: Labels) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in labels)


def _absent(column: Column, decl: ast.Signal | ast.Param, interface: Interface) -> Diagnostic:
    """E103, with the signal that was probably meant."""
    names = interface.signature.names
    near = closest(column.name, names)
    alike = [c.name for c in interface.signature.columns if c.unit.text and c.unit == column.unit]
    found = near if near is not None else (alike[0] if column.unit.text and len(alike) == 1 else None)
    help_: tuple[str, ...] = ()
    if found is not None:
        place = interface.places.get(found)
        where = interface.where if place is None else f"{place.source.name}:{place.line}"
        same = " with the same unit" if found in alike else ""
        role = f"{decl.role} " if isinstance(decl, ast.Signal) and decl.role else ""
        help_ = (
            f'{where} declares `{found}`{same}; write `{role}signal {decl.name} from "{found}"` or rename',
        )
    return Diagnostic(
        "E103",
        f"the system has no signal `{column.name}`",
        decl.name_span,
        f"declared here, absent from {interface.where}",
        help=help_,
        note=(f"signals of {interface.name}: {', '.join(names)}",),
    )


def ranged(
    columns: Sequence[Column], unit: Unit, decl: ast.Signal | ast.Param, scope: Scope
) -> tuple[Column, ...]:
    """The columns with their range, in stored units; ranges of the environment are facts, others are nominal.

    Raises:
        Failed: an end that is not a constant number (E205), of another unit (E203), or an empty range (E205).
    """
    ends = None if decl.domain is None else _ends(decl.domain, (columns[0], unit), scope)
    found = []
    for column in columns:
        if column.labels:
            values = [value for _, value in column.labels]
            column = replace(column, low=min(values), high=max(values), fact=True)
        elif column.kind == "bool":
            column = replace(column, low=0.0, high=1.0, fact=True)
        elif ends is not None and not column.fact:
            column = replace(column, low=ends[0], high=ends[1], fact=column.role == "env")
        found.append(column)
    return tuple(found)


def _ends(
    domain: tuple[ast.Expr, ast.Expr] | ast.SetLiteral | ast.Expr, target: tuple[Column, Unit], scope: Scope
) -> tuple[float | None, float | None] | None:
    """Least and largest value that a domain allows; None for a distribution, and for an end that is `inf`."""
    if isinstance(domain, tuple):
        low, high = _stored(domain, target, scope)
        if low is not None and high is not None and low > high:
            message = "this range is empty: its lower end is above its upper end"
            scope.fail(Diagnostic("E205", message, domain[0].span.to(domain[1].span)))
        return (low, high)
    if isinstance(domain, ast.SetLiteral):
        values = [value for value in _stored(domain.items, target, scope) if value is not None]
        return (min(values), max(values)) if values else None
    evaluate_all((domain,), scope.extended({}, samplers=True))
    return None


def ends_of(
    domain: tuple[ast.Expr, ast.Expr] | ast.SetLiteral, target: tuple[Column, Unit], scope: Scope
) -> Iterator[float | None]:
    """The ends of a range or the members of a set, in the unit of the column; None for `inf`."""
    return _stored(domain if isinstance(domain, tuple) else domain.items, target, scope)


def _stored(exprs: Sequence[ast.Expr], target: tuple[Column, Unit], scope: Scope) -> Iterator[float | None]:
    """Constants in the unit of the column; bare numbers are read in the unit that was declared."""
    column, unit = target
    for expr, value in zip(exprs, evaluate_all(exprs, scope), strict=True):
        if isinstance(value, Moment) and value.end:
            yield None
            continue
        number = as_number(value, expr, Need("the ends of a range are numbers"), scope)
        if number.bare:
            number = in_unit(number, unit if unit.text else column.unit, scope)
        elif not number.flexible and column.unit.text and not same_dims(number.unit, column.unit):
            message = f"`{column.name}` is in [{column.unit}], this is in [{number.unit}]"
            scope.fail(Diagnostic("E203", message, expr.span, f"[{number.unit}]"))
        if number.constant is None:
            scope.fail(Diagnostic("E205", "the ends of a range are constants", expr.span))
        number = on_scale(number, column.unit, expr.span, scope)
        exact, amount = number.exact, number.constant or 0.0
        yield nearest(exact / column.unit.ratio) if exact is not None else amount / column.unit.scale
