"""Resolution of syntax to a typed specification, with names, types and units checked.

    Spec --declare--> entries --evaluate--> typed.Spec

Formulas keep their negations, implications and source locations. Times stay as written: in seconds, in steps,
or as multiples of the planning horizon `T`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import TypeVar

from stlc.compile.frontend.arithmetic import absolute
from stlc.compile.frontend.declare import Declared, check_names, declare, ranged
from stlc.compile.frontend.evaluate import evaluate
from stlc.compile.frontend.expressions import resolve_formula
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.parameters import parameters, read_overrides
from stlc.compile.frontend.scope import Definition, Failed, Scope
from stlc.compile.frontend.tags import reach_of_formula, reach_of_number, read_tags
from stlc.compile.frontend.values import Number, Value, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.functions import Bounds
from stlc.compile.ir.warnings import contradictions, safety_never_violated, vacuous
from stlc.diagnostics import Diagnostic, Findings, SpecError
from stlc.grammar import ast
from stlc.grammar.parser import MAX_ERRORS
from stlc.grammar.spec import Module, Spec
from stlc.signature import Column, Signature
from stlc.source import Span


@dataclass(frozen=True, slots=True)
class File:
    """File of a specification, with its declarations.

    Attributes:
        spec: syntax tree of the file.
        found: declarations of the file.
        scope: scope in which names in the file are resolved.
        files: files that the file imports.
    """

    spec: Spec
    found: Declared
    scope: Scope
    files: tuple[File, ...] = field(default=(), repr=False)


def declared(
    spec: Spec,
    modules: Iterable[Module],
    interface: Interface | None,
    overrides: Mapping[str, ast.Expr],
    scope: Scope,
) -> File:
    """Return a file with its declarations and those of its imports; findings go to `scope`."""
    loaded = []
    for module in modules:
        time_unit = module.spec.time_unit or scope.time_unit
        blank = replace(scope, entries={}, cache={}, time_unit=time_unit)
        loaded.append((module.alias, declared(module.spec, module.imports, interface, {}, blank)))
    found = declare(spec, interface, overrides, scope)
    scopes = {alias: file.scope for alias, file in loaded}
    own = replace(scope, entries=found.entries, cache=dict.fromkeys(found.broken), modules=scopes)
    return File(spec, found, own, tuple(file for _, file in loaded))


def signature_of(file: File, interface: Interface | None) -> tuple[Signature, tuple[typed.Parameter, ...]]:
    """Return the columns and the parameters that a file and its imports declare, without duplicates.

    E104 is reported if two files declare a column differently, or if a file and the system disagree on how a
    parameter is drawn.
    """
    columns: dict[str, tuple[Column, Span]] = {}
    drawn: dict[str, typed.Parameter] = {}
    for where in _every_file(file):
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
                    _check_same(column, decl.name_span, *columns[column.name], file.scope)
    order = [column for column, _ in columns.values()]
    return Signature(tuple(order)), tuple(drawn[column.name] for column in order if column.name in drawn)


def _every_file(file: File) -> Iterator[File]:
    yield file
    for part in file.files:
        yield from _every_file(part)


def _check_same(column: Column, place: Span, known: Column, span: Span, scope: Scope) -> None:
    units = (
        not column.unit.text
        or not known.unit.text
        or (
            column.unit.same_dims(known.unit)
            and column.unit.offset == known.unit.offset
            and math.isclose(column.unit.scale, known.unit.scale)
        )
    )
    if column.kind == known.kind and column.labels == known.labels and units:
        return
    message = f"`{column.name}` is declared differently in two files"
    scope.report(Diagnostic("E104", message, place, labels=(span.label("and here"),)))


def with_ranges(file: File, ranges: Mapping[str, Bounds]) -> File:
    """Return a copy of `file` with ranges of signals in its scope, and in the scopes of all its imports."""
    files = tuple(with_ranges(part, ranges) for part in file.files)
    after = dict(zip((id(part.scope) for part in file.files), (part.scope for part in files), strict=True))
    modules = {alias: after[id(scope)] for alias, scope in file.scope.modules.items()}
    return replace(file, files=files, scope=replace(file.scope, ranges=ranges, modules=modules))


Item = TypeVar("Item")


def resolve(
    spec: Spec,
    *,
    interface: Interface | None = None,
    overrides: Mapping[str, str] | None = None,
    sink: list[Diagnostic] | None = None,
) -> typed.Spec:
    """Return the typed specification: names resolved, types and units checked, macros expanded.

    The result is independent of the time step and horizon.

    Args:
        spec: syntax tree of the specification.
        interface: interface of the system, with which signals and constants are matched.
        overrides: text of the expression that replaces a constant or parameter, by its name (`--set`).
        sink: list to which warnings are appended, also when errors are raised.

    Raises:
        SpecError: all independent errors of the file in source order, at most `MAX_ERRORS`.
        UsageError: U101, an override of an unknown constant.
    """
    values = read_overrides(overrides or {}, spec, interface)
    findings = Findings()
    system_hints = _system_hints(interface)
    scope = Scope(sink=findings, temporal=True, time_unit=spec.time_unit, system_hints=system_hints)
    file = declared(spec, spec.modules(), interface, values, scope)
    _adopt_units(spec, values, file.found, file.scope)
    signature, parameters = signature_of(file, interface)
    facts, ranges = signature.enforced, signature.nominal
    file = with_ranges(file, facts if interface is None else ranges)
    scope = file.scope
    constants = _constants(spec, interface, scope)
    _check_definitions(file)
    requirements = _requirements(spec, ast.Require, scope, ranges)
    assumptions = _requirements(spec, ast.Assume, scope, ranges)
    warnings: list[Diagnostic] = [] if sink is None else sink
    _finish(findings, spec, warnings)
    for requirement, item in zip(requirements, _items(spec, ast.Require), strict=True):
        warnings.extend(_warnings(requirement, item, signature, facts))
    offered = () if interface is None else interface.signature.names
    return typed.Spec(
        name=spec.name or PurePath(spec.source.name).stem,
        signature=signature,
        constants=constants,
        requirements=requirements,
        assumptions=assumptions,
        source_ast=spec,
        parameters=parameters,
        taken=frozenset((*signature.names, *offered)),
        warnings=tuple(warnings),
    )


def _finish(findings: Sequence[Diagnostic], spec: Spec, sink: list[Diagnostic]) -> None:
    """Append the warnings to `sink`; raise all errors together, in source order."""

    def place(finding: Diagnostic) -> tuple[bool, int]:
        span = finding.span
        return (span is not None and span.source == spec.source, 0 if span is None else span.start)

    ordered = sorted(findings, key=place)
    sink.extend(finding for finding in ordered if finding.severity == "warning")
    errors = [finding for finding in ordered if finding.severity == "error"]
    if len(errors) > MAX_ERRORS:
        more = f"{len(errors) - MAX_ERRORS} more errors are not shown"
        errors = [*errors[: MAX_ERRORS - 1], errors[MAX_ERRORS - 1].with_note(more)]
    if errors:
        raise SpecError(*errors)


# ----------------------------------------------------------------- declarations


def _system_hints(interface: Interface | None) -> dict[str, str]:
    """Return a hint for each state and constant of the system, by its name: how to declare it in the file."""
    if interface is None:
        return {}
    found = dict(interface.unread)
    sizes = Counter(column.name.partition("[")[0] for column in interface.signature.columns)
    for column in interface.signature.columns:
        unit = f" [{column.unit}]" if column.unit.text else ""
        name = column.name.partition("[")[0]
        sort = "" if name == column.name else f": real[{sizes[name]}]"
        found[name] = f"{interface.where} has it; declare it here too: `signal {name}{sort}{unit}`"
    for name, (value, unit_) in interface.constants.items():
        amount = _amount(unit_.of_si(value), unit_.text)
        found[name] = f"{interface.where} has it; declare it here too: `const {name} = {amount}`"
    return found


def _adopt_units(spec: Spec, overrides: Mapping[str, ast.Expr], found: Declared, scope: Scope) -> None:
    """Give each override without a unit the unit of the constant that it replaces.

    For example, if the file has `const v = 3 m/s`, the override `v=4` means 4 m/s. The constants in `found`
    are changed in place.
    """
    for item in spec.items:
        entry = found.entries.get(item.name)
        if not isinstance(item, ast.Const) or item.name not in overrides or not isinstance(entry, Definition):
            continue
        if entry.unit is None:
            try:
                original = evaluate(item.value, replace(scope, sink=[], cache=dict(scope.cache)))
            except Failed:
                continue
            if isinstance(original, Number) and not original.flexible:
                found.entries[item.name] = replace(entry, unit=original.unit)


def _constants(spec: Spec, interface: Interface | None, scope: Scope) -> tuple[tuple[str, float], ...]:
    """Return (name, value in SI units) of each constant, one entry per component of a vector.

    E104 is reported for a constant that differs from the system's.
    """
    values: list[tuple[str, float]] = []
    for item in _items(spec, ast.Const):
        try:
            with scope.meter.fresh():
                value = evaluate(ast.Name(item.name_span, item.name, quoted=True), scope)
        except Failed:
            continue
        values.extend(_scalars(item.name, value))
        if interface is not None and isinstance(value, Number):
            _compare(item, value, interface, scope)
    return tuple(values)


def _scalars(name: str, value: Value) -> list[tuple[str, float]]:
    match value:
        case Number() if value.constant is not None:
            return [(name, absolute(value).constant or 0.0)]
        case VectorValue(items):
            return [(f"{name}[{i}]", absolute(item).constant or 0.0) for i, item in enumerate(items)]
        case typed.Truth(_, truth):
            return [(name, float(truth))]
        case _:
            return []


def _compare(item: ast.Const, value: Number, interface: Interface, scope: Scope) -> None:
    """Report the error E104 if a constant differs from the system's constant of the same name."""
    if item.name not in interface.constants or value.constant is None:
        return
    theirs, unit = interface.constants[item.name]
    free = value.flexible or not unit.text
    ours = absolute(value).constant or 0.0
    if math.isclose(ours, theirs, rel_tol=1e-9) and (free or value.unit.same_dims(unit)):
        return
    place = interface.places.get(item.name)
    labels = () if place is None else (place.label("declared here"),)
    here = _amount(value.constant / value.unit.scale, str(value.unit) if value.unit.text else "")
    there = _amount(unit.of_si(theirs), unit.text)
    message = f"`{item.name}` is {here} here and {there} in {interface.where}"
    both = f"make them agree, or change both at once: `--set {item.name}={here.replace(' ', '')}`"
    help_ = (both,) if free or value.unit.same_dims(unit) else ()
    if value.bare and unit.offset:
        help_ = (f"say its unit: `const {item.name} = {here} {unit}`",)
    scope.report(Diagnostic("E104", message, item.name_span, here, labels, help=help_))


def _amount(value: float, unit: str) -> str:
    return f"{value:.12g} {unit}".rstrip()


def _check_definitions(file: File) -> None:
    """Evaluate the definitions of all files, even unused ones, to report their errors."""
    for part in file.files:
        _check_definitions(part)
    scope = file.scope
    for item in file.spec.items:
        entry = scope.entries.get(item.name)
        if not isinstance(item, ast.Def | ast.Region) or not isinstance(entry, Definition):
            continue
        if entry.formals:
            check_names(entry, scope)
            continue
        try:
            with scope.meter.fresh():
                evaluate(ast.Name(item.name_span, item.name, quoted=True), scope)
        except Failed:
            continue


# ----------------------------------------------------------------- requirements


def _items(spec: Spec, kind: type[Item]) -> list[Item]:
    return [item for item in spec.items if isinstance(item, kind)]


def _requirements(
    spec: Spec, kind: type[ast.Require | ast.Assume], scope: Scope, ranges: Mapping[str, Bounds]
) -> tuple[typed.Requirement, ...]:
    """Return the requirements or assumptions (`kind`) that have no errors.

    The errors of the others are reported to `scope`.
    """
    found: list[typed.Requirement] = []
    for item in _items(spec, kind):
        tags = read_tags(item.tags, scope)
        what = f"`{'require' if kind is ast.Require else 'assume'} {item.name}`"
        here = scope.as_products() if tags.product else scope
        try:
            formula = resolve_formula(item.formula, here, what=what)
            place = tags.scale_span or formula.span
            if tags.scale is None:
                scale = reach_of_formula(formula, ranges, place, scope)
            elif isinstance(tags.scale, ir.Const):
                scale = tags.scale.value
            else:
                scale = reach_of_number(tags.scale, ranges, place, scope)
        except Failed:
            continue
        found.append(
            typed.Requirement(
                name=item.name,
                doc=item.doc,
                tags=tags.marks,
                weight=tags.weight,
                scale=scale,
                id=tags.id,
                group=tags.group,
                formula=formula,
                written=item.formula,
                span=item.span,
            )
        )
    return tuple(found)


def _warnings(
    requirement: typed.Requirement, item: ast.Require, signature: Signature, facts: Mapping[str, Bounds]
) -> list[Diagnostic]:
    """Return the warnings about a requirement.

    W502: no finite prefix violates a `@safety` requirement. W503, W312: it always holds, or a part of it.
    W505: a part of it never holds.
    """
    tag = next((tag for tag in item.tags if tag.name == "safety"), None)
    formula = requirement.formula
    found = [*vacuous(formula, signature, facts), *contradictions(formula, signature)]
    weak = safety_never_violated(requirement, None if tag is None else tag.span)
    return found if weak is None else [*found, weak]
