"""Scope of name resolution: known names, findings (errors and warnings), and limits on expression size."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NoReturn, TypeAlias

from stlc.compile.frontend.values import EnumMember, Number, Value, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import Bounds, callable_names, sampler_names
from stlc.diagnostics import Diagnostic, Findings, SpecError, StlcError, SystemFileError, tell
from stlc.grammar import ast
from stlc.signature import Column, Kind
from stlc.similar import closest
from stlc.source import Span
from stlc.units import Unit

MAX_NODES = 50_000
MAX_LEVELS = 120


@dataclass(slots=True)
class Cost:
    """Size (number of nodes) and depth of an expression, with all macros and definitions expanded."""

    nodes: int = 0
    levels: int = 0


@dataclass(slots=True)
class Meter:
    """Counter of the syntax nodes of a declaration, with all macros and definitions expanded.

    Each definition is evaluated once, but counted at every use.

    Attributes:
        nodes: number of nodes counted.
        level: nesting depth of the node that is being evaluated.
        deepest: greatest nesting depth reached.
        reported: whether the current declaration has been reported as too large.
    """

    nodes: int = 0
    level: int = 0
    deepest: int = 0
    reported: bool = False

    @property
    def over(self) -> bool:
        """True if the declaration has more than `MAX_NODES` nodes or is nested deeper than `MAX_LEVELS`."""
        return self.nodes > MAX_NODES or self.deepest > MAX_LEVELS

    def enter(self) -> None:
        """Count one more syntax node, which is one level deeper than the current node.

        The new node becomes the current one.
        """
        self.nodes += 1
        self.level += 1
        self.deepest = max(self.deepest, self.level)

    def leave(self) -> None:
        """Return to the parent of the current syntax node, one level up; the number of nodes stays."""
        self.level -= 1

    def charge(self, cost: Cost) -> None:
        """Count an expression once more, without evaluating it again; `cost` is its size and depth."""
        self.nodes += cost.nodes
        self.deepest = max(self.deepest, self.level + cost.levels)

    @contextmanager
    def measured(self) -> Iterator[Cost]:
        """Context that measures the size and depth of the expressions that are evaluated inside the context.

        These expressions do not count towards the limits of the declaration. The context yields a `Cost`,
        which is filled in when the context ends.
        """
        nodes, deepest, level = self.nodes, self.deepest, self.level
        self.nodes, self.deepest = 0, level
        cost = Cost()
        try:
            yield cost
        finally:
            cost.nodes, cost.levels = self.nodes, self.deepest - level
            self.nodes, self.deepest, self.level = nodes, deepest, level

    @contextmanager
    def fresh(self) -> Iterator[None]:
        """Context in which size and depth are counted from zero.

        The context is entered once per declaration, since the limits hold for each declaration alone. The
        previous counts are restored at the end.
        """
        saved = self.nodes, self.level, self.deepest
        self.nodes, self.level, self.deepest, self.reported = 0, 0, 0, False
        try:
            yield
        finally:
            self.nodes, self.level, self.deepest = saved


_MAX_PAIRS = 20_000
"""Limit on comparisons of unknown names with candidates for "did you mean"."""

_COMPONENT = re.compile(r"(?P<name>.+)\[(?P<index>\d+)\]")


class Failed(Exception):  # noqa: N818 - control flow inside this package; the finding is in the sink already
    """An expression could not be resolved; its errors have been reported to the scope."""


Sort: TypeAlias = Literal["any", "constant", "region", "number", "formula"]


@dataclass(frozen=True, slots=True)
class Known:
    """Name with a value: a signal or an enum member, or a constant of the system.

    Attributes:
        value: its value, in SI units.
        about: description for messages: "env signal, declared at line 14".
        span: source location of its declaration.
    """

    value: Value
    about: str = ""
    span: Span | None = None


@dataclass(frozen=True, slots=True)
class Definition:
    """Name that stands for an expression (macro, constant, region), which is evaluated on first use.

    Attributes:
        name: name of the definition.
        body: the expression.
        formals: names of the arguments.
        unit: unit that the value must have, and that numbers without a unit take; None for any.
        sort: type that the value must have.
        about: description, for messages.
        span: source location of its declaration.
    """

    name: str
    body: ast.Expr
    formals: tuple[str, ...] = ()
    unit: Unit | None = None
    sort: Sort = "any"
    about: str = ""
    span: Span | None = None


@dataclass(frozen=True, slots=True)
class External:
    """Function that the system provides.

    Attributes:
        name: name of the function.
        arguments: size of each vector argument; None for a number.
        result: size of the result; None for a number.
        unit: unit of the result.
        kind: kind of the result: real, int or bool.
        function: function from the components of all arguments to those of the result, or its body in the IR;
            None if it is not loaded.
        about: description, for messages.
        span: source location of its declaration.
        units: unit of each argument, which is checked, and which numbers without a unit take; () if the
            arguments may have any units.
        further: numbers that every call passes to `function` after its own arguments.
    """

    name: str
    arguments: tuple[int | None, ...]
    result: int | None
    unit: Unit
    kind: Kind
    function: Callable[..., Sequence[Any]] | ir.Body | None
    about: str = ""
    span: Span | None = None
    units: tuple[Unit, ...] = ()
    further: tuple[ir.Num, ...] = ()


Entry: TypeAlias = Known | Definition | External


@dataclass(frozen=True, slots=True)
class Scope:
    """Names and rules under which expressions are resolved.

    Attributes:
        entries: declarations of the file, by name.
        sink: receives findings.
        error: class of the errors raised: `SpecError`, or `SystemFileError` in a system file.
        samplers: whether random draws such as `uniform(…)` are allowed.
        temporal: whether temporal operators are allowed.
        earlier: whether `prev(…)` is allowed in numbers of one instant; it reads signals whose names end in
            `ir.BEFORE`.
        time_unit: unit of numbers without a unit in intervals; "" if the file does not declare one.
        ranges: ranges in which divisors must not contain 0, each in the unit in which the signal is stored.
        system_hints: advice for names that only the system declares, by name.
        modules: scopes of imported files, by alias.
        product: whether `x in [lo, hi]` has the robustness `(x - lo) (hi - x)` (`@product`).
        locals: value and expanded size of each argument of the current macro and each quantifier variable.
        meter: counter of the nodes of the current declaration.
        cache: value and expanded size of each definition already evaluated, by name; None if it has errors.
        open: names of the definitions that are being evaluated, in order of nesting.
    """

    entries: Mapping[str, Entry] = field(default_factory=dict)
    sink: list[Diagnostic] = field(default_factory=Findings)
    error: type[StlcError] = SpecError
    samplers: bool = False
    temporal: bool = False
    earlier: bool = False
    time_unit: str = ""
    ranges: Mapping[str, Bounds] = field(default_factory=dict)
    system_hints: Mapping[str, str] = field(default_factory=dict)
    modules: Mapping[str, Scope] = field(default_factory=dict, compare=False)
    product: bool = False
    locals: Mapping[str, tuple[Value, Cost]] = field(default_factory=dict)
    meter: Meter = field(default_factory=Meter, compare=False, repr=False)
    cache: dict[str, tuple[Value, Cost] | None] = field(default_factory=dict, compare=False, repr=False)
    open: tuple[str, ...] = ()

    @property
    def in_spec(self) -> bool:
        """True for a specification, in which `T`, `end` and `dt` are keywords; False for a system file."""
        return not issubclass(self.error, SystemFileError)

    @property
    def sort_error(self) -> str:
        """Code of an error about the type of a value: E205 in a specification, S203 in a system file."""
        return "E205" if self.in_spec else "S203"

    def extended(self, entries: Mapping[str, Entry], *, samplers: bool | None = None) -> Scope:
        """Return a copy of the scope with `entries` as additional names.

        `samplers` says whether random draws are allowed in the copy; None: as in this scope.
        """
        return replace(
            self,
            entries={**self.entries, **entries},
            samplers=self.samplers if samplers is None else samplers,
            cache={},
        )

    def as_products(self) -> Scope:
        """Return the scope for a requirement with the tag `@product`.

        In this scope definitions are evaluated anew, since `x in [lo, hi]` has another robustness there.
        """
        broken = dict.fromkeys(name for name, value in self.cache.items() if value is None)
        modules = {alias: module.as_products() for alias, module in self.modules.items()}
        return replace(self, product=True, cache=broken, modules=modules)

    def report(self, finding: Diagnostic) -> None:
        """Add a finding, unless the same finding was reported before.

        For example, an error in a macro is reported once, even if the macro is used twice.
        """
        tell(self.sink, finding)

    def fail(self, finding: Diagnostic) -> NoReturn:
        """Report a finding and raise Failed."""
        self.report(finding)
        raise Failed

    def unknown(self, name: ast.Name, *, called: bool = False) -> NoReturn:
        """Report an undeclared name (E101) and raise Failed.

        `called`: whether the name is used as a function.
        """
        candidates = [*self.locals, *self.entries]
        if called:
            candidates += [*callable_names(), *(sampler_names() if self.samplers else ())]
        pairs = len(candidates) * (1 + len(self.sink))
        near = closest(name.name, candidates) if pairs <= _MAX_PAIRS else None
        what = "function" if called else "name"
        help_: tuple[str, ...] = ()
        if near is not None:
            entry = self.entries.get(near)
            about = f"  ({entry.about})" if entry is not None and entry.about else ""
            help_ = (f"did you mean `{near}`?{about}",)
        if name.name == "t" and self.in_spec:
            help_ = (
                "a signal's name is its value now: `x`, not `x[t]`; other samples: `prev(x)`, `shift(x, 1)`",
            )
        if name.name in self.system_hints:
            help_ = (self.system_hints[name.name],)
        note = () if called or not self.in_spec else ("parameters never default to 0",)
        self.fail(Diagnostic("E101", f"unknown {what} `{name.name}`", name.span, help=help_, note=note))


def column_value(column: Column) -> Number:
    """Return the value of a column as a number in SI units.

    The number is counted from the zero of its own unit: 20 degC is 20, not 293.15.
    """
    num: ir.Num = ir.Signal(column.name)
    if column.unit.ratio != 1:
        num = num * column.unit.scale
    flexible = column.kind in ("real", "int") and not column.unit.text
    return Number(num, column.unit, flexible, kind=column.kind, labels=column.labels)


def column_entries(
    columns: Iterable[Column], *, about: str = "", span: Span | None = None
) -> dict[str, Known]:
    """Return the name-table entries of columns; `q[0]`, `q[1]`, … form the vector `q`."""
    entries: dict[str, Known] = {}
    for column in columns:
        value = column_value(column)
        match = _COMPONENT.fullmatch(column.name)
        if match is None:
            entries[column.name] = Known(value, about, span)
            continue
        before = entries.get(match["name"])
        items = before.value.items if before is not None and isinstance(before.value, VectorValue) else ()
        entries[match["name"]] = Known(VectorValue((*items, value)), about, span)
    return entries


def member_entries(enums: Iterable[tuple[tuple[str, float], ...]]) -> dict[str, Known]:
    """Return the name-table entries of the members of `enums`.

    If several enums have a member of the same name, the other operand of a comparison decides which is meant.
    """
    options: dict[str, list[tuple[tuple[str, float], ...]]] = {}
    for labels in dict.fromkeys(enums):
        for name, _ in labels:
            options.setdefault(name, []).append(labels)
    return {name: Known(EnumMember(name, tuple(found)), "enum member") for name, found in options.items()}


def reserved(name: str) -> bool:
    """True if `name` is a built-in function."""
    return name in (*callable_names(), *sampler_names())
