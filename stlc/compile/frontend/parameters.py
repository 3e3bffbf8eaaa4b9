"""Parameters (`param`), drawn once per trajectory, and values from the command line (`--set NAME=VALUE`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from stlc.compile.frontend.arithmetic import in_unit, on_scale
from stlc.compile.frontend.coerce import Expectation, loose_number, require_unit
from stlc.compile.frontend.declare import ends_of
from stlc.compile.frontend.evaluate import evaluate
from stlc.compile.frontend.expressions import resolve_numbers, stored
from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import Number, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.ranges import usual_range
from stlc.diagnostics import Diagnostic, SpecError, UsageError, usage
from stlc.grammar import ast
from stlc.grammar.parser import parse_expr
from stlc.grammar.spec import Spec
from stlc.signature import Column
from stlc.source import Source
from stlc.units import Unit


def read_overrides(
    overrides: Mapping[str, str], spec: Spec, interface: Interface | None
) -> dict[str, ast.Expr]:
    """Return the expressions that `--set` gives to constants and parameters of a specification, by name.

    Values for the system are skipped: those of its constants, states and parameters, and those whose name
    contains a dot.

    Raises:
        UsageError: a name is unknown, or a value is not an expression (U101).
    """
    carried = set() if interface is None else {name.partition("[")[0] for name in interface.signature.names}
    systems = set() if interface is None else {*interface.constants, *carried}
    own = {item.name for item in spec.items if isinstance(item, ast.Const)}
    own |= {item.name for item in spec.items if isinstance(item, ast.Param)} - carried
    found: dict[str, ast.Expr] = {}
    faults: list[Diagnostic] = []
    for name, text in overrides.items():
        if name in own:
            try:
                found[name] = parse_expr(Source(f"--set {name}", text))
            except SpecError as error:
                first = error.diagnostics[0]
                message = f"`--set {name}={text}`: {first.message}"
                help_ = (f"write a value with its unit: `--set {name}=3s`",)
                faults.append(Diagnostic("U101", message, first.span, help=help_))
        elif name not in systems and "." not in name:
            faults.append(_unknown(name, own, interface))
    if faults:
        raise UsageError(*faults)
    return found


def _unknown(name: str, own: set[str], interface: Interface | None) -> Diagnostic:
    states = () if interface is None else {each.partition("[")[0] for each in interface.signature.names}
    constants = own | (set() if interface is None else {*interface.constants}) - {*states}
    help_: tuple[str, ...] = ()
    for kind, names in (("constants", constants), ("states, whose initial values it fixes", states)):
        help_ = (*help_, f"{kind}: {', '.join(sorted(names))}") if names else help_
    message = f"`--set {name}=…`: there is no constant or state `{name}`"
    found = Diagnostic("U101", message, help=help_ or ("the specification has no constant",))
    return found.near(name, [*constants, *states])


def parameters(
    decl: ast.Param, columns: Sequence[Column], unit: Unit, interface: Interface | None, scope: Scope
) -> tuple[typed.Parameter, ...]:
    """Return the components of a `param`, each with its distribution.

    Args:
        decl: declaration.
        columns: columns of its components, with their ranges.
        unit: declared unit, which numbers without a unit take.
        interface: interface of the system, which may have the parameter as a state.
        scope: names that the distribution may use; receives findings.

    Raises:
        Failed: the distribution is invalid (E205), has another unit (E203), or differs from that of the
            system (E104).
    """
    carried = interface is not None and columns[0].name in interface.signature
    if carried and interface is not None:
        _agree(decl, columns, interface, scope)
    domain = decl.domain
    if isinstance(domain, tuple | ast.SetLiteral):
        draws = _even(decl, list(ends_of(domain, columns[0], unit, scope)), columns, scope)
    else:
        draws = distribution(domain, columns, unit, scope)
    found = []
    for column, draw in zip(columns, draws, strict=True):
        ends = usual_range(draw) if column.low is None else None
        known = column if ends is None else replace(column, low=ends[0], high=ends[1])
        found.append(typed.Parameter(decl.name_span, known, draw, _text(decl), carried))
    return tuple(found)


def _text(decl: ast.Param) -> str:
    """Return the source text of a parameter's distribution."""
    match decl.domain:
        case (low, high):
            return f"in [{low.span.text}, {high.span.text}]"
        case ast.SetLiteral(items=items):
            return f"in {{{', '.join(item.span.text for item in items)}}}"
        case expr:
            return f"~ {expr.span.text}"


def _even(
    decl: ast.Param, values: Sequence[float | None], columns: Sequence[Column], scope: Scope
) -> tuple[ir.Num, ...]:
    """Return, for each column of a parameter, the uniform distribution over its declared range or set.

    `values` are the two ends of the range or the members of the set.
    """
    if any(value is None for value in values):
        message = f"`{decl.name}` is drawn for every trajectory: its range must have both ends"
        help_ = ("give it a finite range, or a distribution: `param r ~ normal(1, 0.1)`",)
        scope.fail(Diagnostic("E205", message, decl.name_span, help=help_))
    numbers = tuple(ir.Const(value) for value in values if value is not None)
    if isinstance(decl.domain, ast.SetLiteral):
        return tuple(ir.Op("choice", numbers) for _ in columns)
    sampler = "randint" if columns[0].kind == "int" else "uniform"
    return tuple(ir.Op(sampler, numbers) for _ in columns)


def distribution(expr: ast.Expr, columns: Sequence[Column], unit: Unit, scope: Scope) -> tuple[ir.Num, ...]:
    """Return the distribution of each column, in the unit of the column.

    If `expr` is a single number, such as `uniform(0, 1)`, a new value is drawn for each column. If `expr` is
    a vector, each component is the distribution of one column.

    Raises:
        Failed: the unit is not that of the column (E203), or the distribution depends on a signal (E205).
    """
    here = scope.extended({}, samplers=True)
    first = evaluate(expr, here)
    if not isinstance(first, VectorValue):
        values = [first, *(evaluate(expr, here) for _ in columns[1:])]  # one draw for each component
    elif len(first.items) != len(columns):
        message = f"this has {len(first.items)} components, not {len(columns)}"
        scope.fail(Diagnostic("E205", message, expr.span))
    else:
        values = list(first.items)
    need = Expectation("a parameter is a number")
    numbers = [loose_number(value, expr, need, scope) for value in values]
    return tuple(
        _in_column(number, expr, column, unit, scope) for number, column in zip(numbers, columns, strict=True)
    )


def _in_column(number: Number, expr: ast.Expr, column: Column, unit: Unit, scope: Scope) -> ir.Num:
    """Return the distribution `number`, converted to the unit in which `column` is stored.

    If the distribution is written without a unit, it is taken to be in `unit`, the declared unit.

    Raises:
        Failed: the number depends on a signal (E205), or has another unit than the column (E203).
    """
    if number.num.columns:
        message = "a parameter is drawn before anything moves: its distribution reads constants alone"
        scope.fail(Diagnostic("E205", message, expr.span))
    if number.bare:
        wanted = unit if unit.text else column.unit
        if wanted.offset != column.unit.offset:
            return stored(in_unit(number, wanted, scope), column.unit)
        factor = wanted.scale / column.unit.scale
        return number.num if factor == 1 else number.num * factor
    require_unit(number, column, expr, scope)
    return stored(on_scale(number, column.unit, expr.span, scope), column.unit)


def _agree(decl: ast.Param, columns: Sequence[Column], interface: Interface, scope: Scope) -> None:
    """Raise Failed (E104) if specification and system disagree on how a parameter is drawn.

    They disagree if the specification gives a distribution, since the system already has one, or if both give
    a range and the ranges differ.
    """
    place = interface.places.get(columns[0].name)
    labels = () if place is None else (place.label("declared here"),)
    if not isinstance(decl.domain, tuple | ast.SetLiteral):
        message = f"{interface.where} says how `{decl.name}` is drawn, and so does this"
        help_ = (f"say it once: here `env signal {decl.name}`, or take it out of {interface.where}",)
        scope.fail(Diagnostic("E104", message, decl.name_span, labels=labels, help=help_))
    for column in columns:
        own = interface.signature[column.name]
        if None in (own.low, own.high) or (own.low, own.high) == (column.low, column.high):
            continue
        here, there = (f"[{c.low:g}, {c.high:g}]" for c in (column, own))
        message = f"`{column.name}` is in {here} here and in {there} in {interface.where}"
        scope.fail(Diagnostic("E104", message, decl.name_span, here, labels))


def fixed(parameters: Sequence[typed.Parameter], values: Mapping[str, str]) -> tuple[typed.Parameter, ...]:
    """Return all parameters; those named in `values` are fixed to a constant, and no longer drawn at random.

    A constant may be outside the declared range.

    Args:
        parameters: components of all parameters.
        values: value of each parameter to be fixed, as text: `0.8 m`, or `[1 m, 2 m]` for a vector.

    Raises:
        UsageError: a value is not valid for its parameter (U101).
    """
    groups: dict[str, list[typed.Parameter]] = {}
    for each in parameters:
        groups.setdefault(each.column.name.partition("[")[0], []).append(each)
    found = []
    for name, group in groups.items():
        found.extend(_given(name, group, values[name]) if name in values else group)
    return tuple(found)


def _given(name: str, group: Sequence[typed.Parameter], text: str) -> list[typed.Parameter]:
    """Return the components of one parameter (`group`), fixed to the value in `text`.

    Raises:
        UsageError: the value is not valid for the parameter (U101).
    """
    what = f"`{name}`"
    column = group[0].column
    try:
        expr = parse_expr(Source(f"--set {name}", text))
        numbers = resolve_numbers(expr, Scope(), expected=column, what=what)
    except SpecError as error:
        raise _unfit(name, text, error.diagnostics[0].message) from None
    if len(numbers) != len(group) or any(number.constant is None for number in numbers):
        raise _unfit(name, text, f"{what} takes {len(group)} constant value{'s' if len(group) > 1 else ''}")
    return [
        replace(each, draw=stored(number, each.column.unit), text=f"= {text}")
        for each, number in zip(group, numbers, strict=True)
    ]


def _unfit(name: str, text: str, reason: str) -> UsageError:
    return usage(f"`--set {name}={text}`: {reason}")
