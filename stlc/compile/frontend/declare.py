"""The names that a file declares: what each means, and which are declared twice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from stlc.compile.frontend.algebra import rebased
from stlc.compile.frontend.externs import external
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.scope import (
    Definition,
    Entry,
    Failed,
    Known,
    Scope,
    Sort,
    column_entries,
    member_entries,
)
from stlc.compile.frontend.signals import Labels, check_type, columns_of, declared_unit
from stlc.compile.frontend.tags import refuse_tags
from stlc.compile.frontend.values import Number, Value, Vector
from stlc.compile.ir.functions import FUNCTIONS, callable_names
from stlc.diagnostics import Diagnostic, Label
from stlc.grammar import ast
from stlc.signature import Column
from stlc.source import Span
from stlc.units import Unit

_SORTS: Mapping[str, Sort] = {"real": "number", "int": "number", "bool": "formula", "formula": "formula"}


@dataclass(slots=True)
class Declared:
    """What the declarations of a file come to.

    Attributes:
        entries: value namespace.
        enums: type namespace.
        columns: of signals and parameters, ranges not yet known, with the unit that was declared.
        broken: names whose declaration has been reported; their uses are not reported again.
    """

    entries: dict[str, Entry] = field(default_factory=dict)
    enums: dict[str, Labels] = field(default_factory=dict)
    columns: list[tuple[ast.Signal | ast.Param, tuple[Column, ...], Unit]] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)


def declare(
    spec: ast.Spec, interface: Interface | None, overrides: Mapping[str, ast.Expr], scope: Scope
) -> Declared:
    """Every name of the file, with findings in the scope (E101, E102, E103, E104, E203, E501).

    Args:
        spec: as parsed.
        interface: of the system, if there is one.
        overrides: values that replace those of constants.
        scope: where findings go; its names are not read.
    """
    found = Declared()
    _check_twice(spec, scope)
    for item in spec.items:
        if isinstance(item, ast.Enum):
            refuse_tags(item.tags, "an enum", scope)
            _declare_enum(item, found, scope)
    for item in spec.items:
        if isinstance(item, ast.Enum | ast.Require | ast.Assume):
            continue
        refuse_tags(item.tags, f"a `{_keyword(item)}`", scope)
        if item.name in found.entries:
            continue
        try:
            found.entries[item.name] = _entry(item, found, interface, overrides, scope)
        except Failed:
            found.broken.add(item.name)
            found.entries[item.name] = Definition(
                item.name, ast.Bool(item.name_span, True), span=item.name_span
            )
    return found


def _keyword(item: ast.Item) -> str:
    return type(item).__name__.lower()


def _check_twice(spec: ast.Spec, scope: Scope) -> None:
    """E102, for values, for types, for requirements, and for imported files."""
    spaces: dict[str, dict[str, tuple[Span, str]]] = {"value": {}, "type": {}, "rule": {}, "file": {}}
    for written in spec.imports:
        if written.alias is not None:
            _claim(written.alias, written.span, "", spaces["file"], scope)
    for item in spec.items:
        space = {ast.Enum: "type", ast.Require: "rule", ast.Assume: "rule"}.get(type(item), "value")
        _claim(item.name, item.name_span, "", spaces[space], scope)
        if isinstance(item, ast.Enum):
            for name, _ in item.members:
                _claim(name, item.name_span, item.name, spaces["value"], scope)
        if isinstance(item, ast.Def) and item.formals and item.name in (*callable_names(), *FUNCTIONS):
            help_ = ("give it another name",)
            message = f"`{item.name}` is a built-in function"
            scope.report(Diagnostic("E102", message, item.name_span, help=help_))


def _claim(name: str, span: Span, enum: str, space: dict[str, tuple[Span, str]], scope: Scope) -> None:
    """Take a name, or report who has it; enums may share members with each other."""
    if name not in space:
        space[name] = (span, enum)
        return
    first, owner = space[name]
    if enum and owner and enum != owner:
        return
    labels = (Label(first, "first definition" if not owner else f"a member of `{owner}`"),)
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


def _entry(
    item: ast.Item,
    found: Declared,
    interface: Interface | None,
    overrides: Mapping[str, ast.Expr],
    scope: Scope,
) -> Entry:
    about = f"{_keyword(item)}, declared at line {item.name_span.line}"
    match item:
        case ast.Param() if item.name in overrides:
            check_type(item.type, found.enums, scope)
            unit = declared_unit(item.unit, item, scope) if item.unit else None
            return Definition(
                item.name, overrides[item.name], (), unit, "constant", f"{about}, set", item.name_span
            )
        case ast.Signal() | ast.Param():
            return _column_entry(item, found, interface, scope)
        case ast.Const():
            check_type(item.type, found.enums, scope)
            unit = declared_unit(item.unit, item, scope) if item.unit else None
            body = overrides.get(item.name, item.value)
            return Definition(item.name, body, (), unit, "constant", about, item.name_span)
        case ast.Region():
            return Definition(item.name, item.value, sort="region", about=about, span=item.name_span)
        case ast.Def():
            return _macro(item, about, found, scope)
        case ast.Extern():
            return external(item, interface, about, scope)
        case _:
            raise AssertionError("enums and requirements are no values")


def _column_entry(
    item: ast.Signal | ast.Param, found: Declared, interface: Interface | None, scope: Scope
) -> Known:
    columns = columns_of(item, found.enums, interface, scope)
    unit = declared_unit(item.unit, item, scope)
    found.columns.append((item, columns, unit))
    role = f"{item.role} signal" if isinstance(item, ast.Signal) and item.role else _keyword(item)
    about = f"{role}, declared at line {item.name_span.line}"
    if interface is not None and columns[0].name in interface.signature:
        about += f"; also a state of {interface.where}"
    (entry,) = column_entries(columns, about=about, span=item.name_span).values()
    return replace(entry, value=_read_in(entry.value, unit)) if unit.text else entry


def _read_in(value: Value, unit: Unit) -> Value:
    """A signal whose bare numbers are in the unit that the file declares, whatever the system stores."""
    if isinstance(value, Vector):
        return replace(value, items=tuple(rebased(item, unit) for item in value.items))
    return rebased(value, unit) if isinstance(value, Number) else value


def _macro(item: ast.Def, about: str, found: Declared, scope: Scope) -> Definition:
    check_type(item.type, found.enums, scope)
    for formal in item.formals:
        check_type(formal.type, found.enums, scope)
    names = tuple(formal.name for formal in item.formals)
    if len(set(names)) < len(names):
        scope.fail(Diagnostic("E102", f"two arguments of `{item.name}` have one name", item.name_span))
    sized = item.type is not None and item.type.size is not None
    sort: Sort = "any" if item.type is None or sized else _SORTS.get(item.type.name, "any")
    return Definition(item.name, item.value, names, None, sort, about, item.name_span)
