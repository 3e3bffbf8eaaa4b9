"""Imported files as scopes: what their names mean, and the columns that they bring."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from stlc.compile.frontend.declare import Declared, declare
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.modules import Module
from stlc.compile.frontend.parameters import parameters
from stlc.compile.frontend.scope import Failed, Scope
from stlc.compile.frontend.signals import ranged
from stlc.compile.ir import typed
from stlc.compile.ir.functions import Bounds
from stlc.diagnostics import Diagnostic, Label
from stlc.grammar import ast
from stlc.signature import Column, Signature
from stlc.source import Span
from stlc.units import same_dims


@dataclass(frozen=True, slots=True)
class File:
    """One file, declared.

    Attributes:
        spec: as parsed.
        found: its names.
        scope: in which they mean something.
        files: what it imports.
    """

    spec: ast.Spec
    found: Declared
    scope: Scope
    files: tuple[File, ...] = field(default=(), repr=False)


def declared(
    spec: ast.Spec,
    modules: Iterable[Module],
    interface: Interface | None,
    overrides: Mapping[str, ast.Expr],
    scope: Scope,
) -> File:
    """A file and all that it imports, findings in the scope."""
    loaded = [(module.alias, _of_module(module, interface, scope)) for module in modules]
    found = declare(spec, interface, overrides, scope)
    scopes = {alias: file.scope for alias, file in loaded}
    own = replace(scope, entries=found.entries, cache=dict.fromkeys(found.broken), modules=scopes)
    return File(spec, found, own, tuple(file for _, file in loaded))


def _of_module(module: Module, interface: Interface | None, scope: Scope) -> File:
    blank = replace(scope, entries={}, cache={}, time_unit=module.spec.time_unit or scope.time_unit)
    return declared(module.spec, module.imports, interface, {}, blank)


def signature_of(file: File, interface: Interface | None) -> tuple[Signature, tuple[typed.Parameter, ...]]:
    """The columns of a file and of what it imports, each once, and those that are parameters.

    E104 where two files differ about one, or the system has other values for a parameter.
    """
    columns: dict[str, tuple[Column, Span]] = {}
    drawn: dict[str, typed.Parameter] = {}
    for where in _every(file):
        for decl, plain, unit in where.found.columns:
            try:
                found = ranged(plain, unit, decl, where.scope)
                if isinstance(decl, ast.Param):
                    made = parameters(decl, found, unit, interface, where.scope)
                    drawn = {part.column.name: part for part in made} | drawn
                    found = tuple(part.column for part in made)
            except Failed:
                found = plain
            for column in found:
                if column.name not in columns:
                    columns[column.name] = (column, decl.name_span)
                elif where is not file:
                    _check_same(column, decl.name_span, columns[column.name], file.scope)
    order = [column for column, _ in columns.values()]
    return Signature(tuple(order)), tuple(drawn[column.name] for column in order if column.name in drawn)


def _every(file: File) -> Iterator[File]:
    yield file
    for part in file.files:
        yield from _every(part)


def _check_same(column: Column, place: Span, first: tuple[Column, Span], scope: Scope) -> None:
    known, span = first
    units = (
        not column.unit.text
        or not known.unit.text
        or (
            same_dims(column.unit, known.unit)
            and column.unit.offset == known.unit.offset
            and math.isclose(column.unit.scale, known.unit.scale)
        )
    )
    if column.kind == known.kind and column.labels == known.labels and units:
        return
    message = f"`{column.name}` is declared differently in two files"
    scope.report(Diagnostic("E104", message, place, labels=(Label(span, "and here"),)))


def with_facts(file: File, facts: Mapping[str, Bounds]) -> File:
    """The same file where the enforced ranges of all columns are known."""
    files = tuple(with_facts(part, facts) for part in file.files)
    after = dict(zip((id(part.scope) for part in file.files), (part.scope for part in files), strict=True))
    modules = {alias: after[id(scope)] for alias, scope in file.scope.modules.items()}
    return replace(file, files=files, scope=replace(file.scope, facts=facts, modules=modules))
