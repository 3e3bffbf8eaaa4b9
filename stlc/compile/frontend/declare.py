"""Declarations of a file: names, signals with their units and ranges, functions of a system."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from stlc.compile.frontend.arithmetic import in_unit, on_scale, rebased
from stlc.compile.frontend.coerce import Expectation, as_number, require_unit
from stlc.compile.frontend.evaluate import evaluate_all
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.scope import (
    Definition,
    Entry,
    External,
    Failed,
    Known,
    Scope,
    Sort,
    column_entries,
    column_value,
    member_entries,
)
from stlc.compile.frontend.tags import refuse_tags, require_between
from stlc.compile.frontend.values import Number, TimeExpr, VectorValue
from stlc.compile.ir.functions import FUNCTIONS, callable_names, sampler_names
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.grammar.words import BUILT_IN
from stlc.signature import Column, Kind, Role
from stlc.similar import closest
from stlc.source import Span
from stlc.units import Unit, nearest


def check_names(entry: Definition, scope: Scope) -> None:
    """Report the error E101 for every name in the body of a macro that is not declared."""
    functions = {*callable_names(), *sampler_names()}
    for name, called in _free(entry.body, frozenset(entry.formals)):
        if name.name in scope.entries or (name.name in BUILT_IN and not name.quoted):
            continue
        if called and name.name in functions:
            continue
        try:
            scope.unknown(name, called=called)
        except Failed:
            continue


def _free(node: object, bound: frozenset[str]) -> Iterator[tuple[ast.Name, bool]]:
    """Yield each free name in an expression, and whether the name is called as a function.

    A name is not free if it is in `bound`, or if a quantifier or a `freeze` in the expression binds it. Names
    of modules are left out.
    """
    if isinstance(node, ast.Name):
        if node.name not in bound:
            yield node, False
        return
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        yield node.func, True
    parts: Iterable[object] = ()
    if isinstance(node, tuple):
        parts = node
    elif isinstance(node, ast.Node) and not isinstance(node, ast.Attr):
        skipped = ("span", "func") if isinstance(node, ast.Call) else ("span",)
        parts = [getattr(node, field.name) for field in fields(node) if field.name not in skipped]
    for part in parts:
        yield from _free(part, bound | _binds(node))


def _binds(node: object) -> frozenset[str]:
    match node:
        case ast.Quantifier(_, _, var):
            return frozenset((var,))
        case ast.Freeze(_, bindings):
            return frozenset(name for name, _ in bindings)
        case _:
            return frozenset()


_EXTERN_KINDS: dict[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


def external(item: ast.Extern, interface: Interface | None, about: str, scope: Scope) -> External:
    """Return the function that an `extern fn` declares; `about` describes the function in messages.

    Raises:
        Failed: an invalid type (E101) or vector size (E005), or a function that the system lacks (E107).
    """
    types = [formal.type for formal in item.formals]
    for written in (*types, item.type):
        if written is not None:
            _check_extern_type(written, scope)
    if interface is not None and item.name not in interface.externs:
        scope.fail(_absent_function(item, interface))
    arguments = tuple(None if type_ is None else type_.size for type_ in types)
    loaded = None if interface is None else interface.functions.get(item.name)
    return External(
        name=item.name,
        arguments=arguments,
        result=item.type.size,
        unit=declared_unit(item.unit, item, scope),
        kind=_EXTERN_KINDS[item.type.name],
        function=None if loaded is None else loaded.bound(arguments, item.type.size),
        about=about,
        span=item.name_span,
    )


def _check_extern_type(written: ast.TypeRef, scope: Scope) -> None:
    if written.name not in _EXTERN_KINDS:
        message = f"`{written.name}` cannot pass to or from a function outside"
        help_ = ("types: real, int, bool, and vectors `real[3]`",)
        scope.fail(Diagnostic("E101", message, written.span, help=help_))
    if written.size is not None and not 1 <= written.size <= Column.MAX_COMPONENTS:
        message = f"a vector has between 1 and {Column.MAX_COMPONENTS} components"
        scope.fail(Diagnostic("E005", message, written.span))


def _absent_function(item: ast.Extern, interface: Interface) -> Diagnostic:
    line = f'functions: {{{item.name}: {{kind: python, target: "package.module:{item.name}"}}}}'
    return Diagnostic(
        "E107",
        f"the system provides no function `{item.name}`",
        item.name_span,
        f"declared here, absent from {interface.where}",
        help=(line,),
    ).near(item.name, interface.externs)


Labels = tuple[tuple[str, float], ...]

_KINDS: Mapping[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


_TEMPERATURE = re.compile("temp|therm|celsius|heat|cool|oven|ambient", re.IGNORECASE)


def declared_unit(text: str, decl: ast.Declaration, scope: Scope) -> Unit:
    """Return the unit `text`, which a declaration gives in brackets, as in `[m/s]`.

    If `text` is empty, the result is the unit of dimensionless numbers. W107 is reported for a name such as
    `temp` in coulombs (`[C]`).

    Raises:
        Failed: the unit is unknown (E203).
    """
    if not text:
        return Unit.ONE
    try:
        unit = Unit.parse(text)
    except ValueError as error:
        return scope.fail(
            Diagnostic("E203", str(error), decl.name_span, help=("units: m, s, m/s^2, deg, 1, …",))
        )
    if text.strip() == "C" and _TEMPERATURE.search(decl.name_span.text):
        message = f"`{decl.name_span.text}` is declared in coulombs [C]"
        scope.report(Diagnostic("W107", message, decl.name_span, help=(Unit.CELSIUS,)))
    return unit


def check_type(type_: ast.TypeRef | None, enums: Mapping[str, Labels], scope: Scope) -> None:
    """Check the type in a declaration.

    Raises:
        Failed: the type is not declared (E101), or its vector size is invalid (E005).
    """
    if type_ is None:
        return
    if type_.name not in _KINDS and type_.name not in enums and type_.name != "formula":
        unknown = Diagnostic("E101", f"unknown type `{type_.name}`", type_.span)
        scope.fail(unknown.near(type_.name, (*_KINDS, *enums), "types: real, int, bool, or an enum"))
    if type_.size is not None and not 1 <= type_.size <= Column.MAX_COMPONENTS:
        message = f"a vector has between 1 and {Column.MAX_COMPONENTS} components"
        scope.fail(Diagnostic("E005", message, type_.span))


def columns_of(
    decl: ast.Signal | ast.Param, enums: Mapping[str, Labels], interface: Interface | None, scope: Scope
) -> tuple[Column, ...]:
    """Return the columns (name, unit, type, role) of a signal or parameter, one per component.

    If there is a system, each column gets the unit and range of the system's column of the same name. The
    range that the file declares is added later, by `ranged`.

    Raises:
        Failed: the type is unknown (E101), or the system lacks the signal (E103) or declares it with another
            type (E104) or unit (E203).
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
    """Return a declared column with the unit and range of the system's column of the same name.

    Raises:
        Failed: the system lacks the column (E103), or declares it with another unit (E203) or type (E104).
    """
    if column.name not in interface.signature:
        if isinstance(decl, ast.Param):
            return column
        scope.fail(_absent_signal(column, decl, interface))
    own = interface.signature[column.name]
    place = interface.places.get(column.name)
    labels = () if place is None else (place.label("declared here"),)
    if column.unit.text and own.unit.text and not column.unit.same_dims(own.unit):
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


def _absent_signal(column: Column, decl: ast.Signal | ast.Param, interface: Interface) -> Diagnostic:
    """Return the error E103 for a signal that the system lacks.

    The error suggests a signal of the system: one with a similar name, or the only one with the same unit.
    """
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
    own = interface.unread.get(column.name.partition("[")[0])
    help_ = help_ if own is None else (own,)
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
    """Return the columns with their declared ranges, each in the unit of its column.

    The ranges of `env` signals are enforced: analyses may rely on them. The ranges of other signals are
    nominal: a signal may leave its range.

    Raises:
        Failed: a bound that is not constant (E205) or has another unit (E203), or an empty range (E205).
    """
    ends = None if decl.domain is None else _ends(decl.domain, columns[0], unit, scope)
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
    domain: tuple[ast.Expr, ast.Expr] | ast.SetLiteral | ast.Expr, column: Column, unit: Unit, scope: Scope
) -> tuple[float | None, float | None] | None:
    """Return the least and greatest value of a declared range or set, in the unit of the column.

    The least or greatest value is None if the bound is `inf`. The whole result is None for a distribution,
    and for a set without values.
    """
    if isinstance(domain, tuple):
        low, high = _stored(domain, column, unit, scope)
        if low is not None and high is not None and low > high:
            message = "this range is empty: its lower end is above its upper end"
            scope.fail(Diagnostic("E205", message, domain[0].span.to(domain[1].span)))
        return (low, high)
    if isinstance(domain, ast.SetLiteral):
        values = [value for value in _stored(domain.items, column, unit, scope) if value is not None]
        return (min(values), max(values)) if values else None
    evaluate_all((domain,), scope.extended({}, samplers=True))
    return None


def ends_of(
    domain: tuple[ast.Expr, ast.Expr] | ast.SetLiteral, column: Column, unit: Unit, scope: Scope
) -> Iterator[float | None]:
    """Yield the ends of a range or the members of a set, in the unit of the column; None for `inf`."""
    return _stored(domain if isinstance(domain, tuple) else domain.items, column, unit, scope)


def _stored(exprs: Sequence[ast.Expr], column: Column, unit: Unit, scope: Scope) -> Iterator[float | None]:
    """Yield the values of constant expressions in the unit of `column`; None for `inf`.

    A number without a unit is taken to be in `unit`, the declared unit, and then converted.
    """
    for expr, value in zip(exprs, evaluate_all(exprs, scope), strict=True):
        if isinstance(value, TimeExpr) and value.end:
            yield None
            continue
        number = as_number(value, expr, Expectation("the ends of a range are numbers"), scope)
        if number.bare:
            number = in_unit(number, unit if unit.text else column.unit, scope)
        else:
            require_unit(number, column, expr, scope)
        if number.constant is None:
            scope.fail(Diagnostic("E205", "the ends of a range are constants", expr.span))
        number = on_scale(number, column.unit, expr.span, scope)
        exact, amount = number.exact, number.constant or 0.0
        yield nearest(exact / column.unit.ratio) if exact is not None else amount / column.unit.scale


_SORTS: Mapping[str, Sort] = {"real": "number", "int": "number", "bool": "formula", "formula": "formula"}


@dataclass(slots=True)
class Declared:
    """Declarations of a file.

    Attributes:
        entries: meaning of each declared name (signal, constant, definition, function, enum member), by name.
        enums: (member, value) pairs of each enum, by the name of the enum.
        columns: one tuple per signal and parameter: its declaration, its columns, its declared unit. The
            columns do not yet have the declared range.
        broken: names with an invalid declaration, whose uses are not reported again.
    """

    entries: dict[str, Entry] = field(default_factory=dict)
    enums: dict[str, Labels] = field(default_factory=dict)
    columns: list[tuple[ast.Signal | ast.Param, tuple[Column, ...], Unit]] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)


def declare(
    spec: Spec, interface: Interface | None, overrides: Mapping[str, ast.Expr], scope: Scope
) -> Declared:
    """Return the declarations of a file, and report the errors in them to `scope`.

    E101 is an unknown type, E102 a name declared twice, E103 a signal that the system lacks, E104 a signal of
    another type than in the system, E203 a signal of another unit, E501 a tag on a declaration that takes
    none.

    Args:
        spec: syntax tree of the file.
        interface: interface of the system, or None.
        overrides: expression that replaces the value of a constant or parameter, by its name.
        scope: receives the findings. Names that are already in the scope are not used.
    """
    _check_twice(spec, scope)
    builder = _EntryBuilder(interface, overrides, scope)
    found = builder.found
    for item in spec.items:
        if isinstance(item, ast.Enum):
            refuse_tags(item.tags, "an enum", scope)
            _declare_enum(item, found, scope)
    for item in spec.items:
        if isinstance(item, ast.Enum | ast.Require | ast.Assume):
            continue
        if isinstance(item, ast.Signal):
            require_between(item.tags, scope)
        else:
            refuse_tags(item.tags, f"a `{_keyword(item)}`", scope)
        if item.name in found.entries:
            continue
        try:
            found.entries[item.name] = _ENTRIES[type(item)](builder, item)
        except Failed:
            found.broken.add(item.name)
            found.entries[item.name] = Definition(
                item.name, ast.Bool(item.name_span, True), span=item.name_span
            )
    return found


def _keyword(item: ast.Declaration) -> str:
    return type(item).__name__.lower()


def _check_twice(spec: Spec, scope: Scope) -> None:
    """Report the error E102 for a value, type, requirement or import that is declared twice."""
    spaces: dict[str, dict[str, tuple[Span, str]]] = {"value": {}, "type": {}, "rule": {}, "file": {}}
    for written in spec.imports:
        if written.alias is not None:
            _claim(written.alias, written.span, "", spaces["file"], scope)
    for item in spec.items:
        space = {"enum": "type", "requirement": "rule", "assumption": "rule"}.get(item.noun, "value")
        _claim(item.name, item.name_span, "", spaces[space], scope)
        if isinstance(item, ast.Enum):
            for name, _ in item.members:
                _claim(name, item.name_span, item.name, spaces["value"], scope)
        if isinstance(item, ast.Def) and item.formals and item.name in (*callable_names(), *FUNCTIONS):
            help_ = ("give it another name",)
            message = f"`{item.name}` is a built-in function"
            scope.report(Diagnostic("E102", message, item.name_span, help=help_))


def _claim(name: str, span: Span, enum: str, space: dict[str, tuple[Span, str]], scope: Scope) -> None:
    """Record the declaration of `name` in `space`; report E102 if the name is already there.

    `space` contains the source location and the enum of each name recorded so far. `enum` is the enum of
    which `name` is a member, "" for any other name. Different enums may have members of the same name.
    """
    if name not in space:
        space[name] = (span, enum)
        return
    first, owner = space[name]
    if enum and owner and enum != owner:
        return
    labels = (first.label("first definition" if not owner else f"a member of `{owner}`"),)
    help_ = (f"rename one, or delete line {span.line}",)
    scope.report(
        Diagnostic("E102", f"`{name}` is defined twice", span, "second definition", labels, help=help_)
    )


def _declare_enum(item: ast.Enum, found: Declared, scope: Scope) -> None:
    labels = tuple((name, float(value)) for name, value in item.members)
    if len(dict(labels)) < len(labels) or len({value for _, value in labels}) < len(labels):
        message = f"two members of `{item.name}` have one name or one value"
        scope.report(Diagnostic("E102", message, item.name_span))
    found.enums.setdefault(item.name, labels)
    about = f"member of enum {item.name}, declared at line {item.name_span.line}"
    for name, known in member_entries(found.enums.values()).items():
        before = found.entries.get(name)
        if isinstance(before, Known):
            found.entries[name] = replace(before, value=known.value)
        else:
            found.entries[name] = replace(known, about=about, span=item.name_span)


@dataclass(frozen=True, slots=True)
class _EntryBuilder:
    """Builder of the entries in the name table of a file, with a method for each kind of declaration."""

    interface: Interface | None
    overrides: Mapping[str, ast.Expr]
    scope: Scope
    found: Declared = field(default_factory=Declared)

    def column(self, item: ast.Signal | ast.Param) -> Known:
        columns = columns_of(item, self.found.enums, self.interface, self.scope)
        unit = declared_unit(item.unit, item, self.scope)
        self.found.columns.append((item, columns, unit))
        role = f"{item.role} " if isinstance(item, ast.Signal) and item.role else ""
        about = role + _about(item)
        if self.interface is not None and columns[0].name in self.interface.signature:
            about += f"; also a state of {self.interface.where}"
        if item.type is None or item.type.size is None:  # a number, also where its column is called `q[0]`
            entry = Known(column_value(columns[0]), about, item.name_span)
        else:
            (entry,) = column_entries(columns, about=about, span=item.name_span).values()
        value = entry.value
        if unit.text and isinstance(value, VectorValue):  # the system may store the signal in another unit
            parts = tuple(rebased(part, unit) for part in value.items)
            return replace(entry, value=replace(value, items=parts))
        if unit.text and isinstance(value, Number):
            return replace(entry, value=rebased(value, unit))
        return entry

    def parameter(self, item: ast.Param) -> Entry:
        if item.name not in self.overrides:
            return self.column(item)
        entry = self.constant(item, self.overrides[item.name])
        return replace(entry, about=f"{entry.about}, set")

    def constant(self, item: ast.Const | ast.Param, body: ast.Expr) -> Definition:
        check_type(item.type, self.found.enums, self.scope)
        unit = declared_unit(item.unit, item, self.scope) if item.unit else None
        return Definition(item.name, body, (), unit, "constant", _about(item), item.name_span)

    def region(self, item: ast.Region) -> Definition:
        return Definition(item.name, item.value, sort="region", about=_about(item), span=item.name_span)

    def macro(self, item: ast.Def) -> Definition:
        for written in (item.type, *(formal.type for formal in item.formals)):
            check_type(written, self.found.enums, self.scope)
        names = tuple(formal.name for formal in item.formals)
        if len(set(names)) < len(names):
            message = f"two arguments of `{item.name}` have one name"
            self.scope.fail(Diagnostic("E102", message, item.name_span))
        sized = item.type is not None and item.type.size is not None
        sort: Sort = "any" if item.type is None or sized else _SORTS.get(item.type.name, "any")
        return Definition(item.name, item.value, names, None, sort, _about(item), item.name_span)


_ENTRIES: Mapping[type, Callable[[_EntryBuilder, Any], Entry]] = {
    ast.Signal: _EntryBuilder.column,
    ast.Param: _EntryBuilder.parameter,
    ast.Const: lambda builder, item: builder.constant(item, builder.overrides.get(item.name, item.value)),
    ast.Region: _EntryBuilder.region,
    ast.Def: _EntryBuilder.macro,
    ast.Extern: lambda builder, item: external(item, builder.interface, _about(item), builder.scope),
}
"""Class of declarations -> function that returns the entry of a declaration in the name table."""


def _about(item: ast.Declaration) -> str:
    return f"{_keyword(item)}, declared at line {item.name_span.line}"
