"""The names of an expression while it is resolved, its findings, and how large it may grow."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Literal, NoReturn, TypeAlias

from stlc.compile.frontend.values import EnumMember, Number, Origin, Value, Vector
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import Bounds, callable_names, sampler_names
from stlc.diagnostics import Diagnostic, Findings, SpecError, StlcError, SystemFileError, tell
from stlc.grammar import ast
from stlc.registry import closest
from stlc.signature import Column, Kind
from stlc.source import Span
from stlc.units import DIMENSIONLESS, Unit, nearest

MAX_NODES = 50_000
MAX_LEVELS = 120


@dataclass(slots=True)
class Cost:
    """Size and depth of an expression, written out in full."""

    nodes: int = 0
    levels: int = 0


@dataclass(slots=True)
class Meter:
    """Counts nodes as if every definition were written out, although each is evaluated once.

    Attributes:
        nodes: so far.
        level: of nesting right now.
        deepest: largest level so far.
        reported: the excess of the declaration at hand has been reported.
    """

    nodes: int = 0
    level: int = 0
    deepest: int = 0
    reported: bool = False

    @property
    def over(self) -> bool:
        """True if a limit is passed."""
        return self.nodes > MAX_NODES or self.deepest > MAX_LEVELS

    def enter(self) -> None:
        """One node deeper."""
        self.nodes += 1
        self.level += 1
        self.deepest = max(self.deepest, self.level)

    def leave(self) -> None:
        """Back to the node around it."""
        self.level -= 1

    def charge(self, cost: Cost) -> None:
        """Count something that was evaluated before as if it were written here."""
        self.nodes += cost.nodes
        self.deepest = max(self.deepest, self.level + cost.levels)

    @contextmanager
    def measured(self) -> Iterator[Cost]:
        """Yields a `Cost` that tells, after the block, what was evaluated inside without being charged."""
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
        """A budget of its own: a declaration is not charged for its neighbours."""
        saved = self.nodes, self.level, self.deepest
        self.nodes, self.level, self.deepest, self.reported = 0, 0, 0, False
        try:
            yield
        finally:
            self.nodes, self.level, self.deepest = saved


TIME_WORDS = ("T", "end", "dt")
_MAX_PAIRS = 20_000
"""Of names and candidates that are compared for "did you mean" before the rest goes without."""

_COMPONENT = re.compile(r"(?P<name>.+)\[(?P<index>\d+)\]")


class Failed(Exception):  # noqa: N818 - control flow inside this room; the finding is in the sink already
    """An expression could not be resolved, and its findings have been reported."""


Sort: TypeAlias = Literal["any", "constant", "region", "number", "formula"]


@dataclass(frozen=True, slots=True)
class Known:
    """A name with a value: a signal, a constant, a member of an enum.

    Attributes:
        value: in SI units.
        about: what it is, for messages: "env signal, declared at line 14".
        span: where it was declared.
    """

    value: Value
    about: str = ""
    span: Span | None = None


@dataclass(frozen=True, slots=True)
class Definition:
    """A name with an expression: a macro, a constant, a region; resolved when it is first used.

    Attributes:
        name: of the definition.
        body: the expression.
        formals: names of the arguments.
        unit: unit that the number must have, and that a bare number takes; None for any.
        sort: what the body must be.
        about: what it is, for messages.
        span: where its name was declared.
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
    """A function that the system provides.

    Attributes:
        name: of the function.
        arguments: size of each vector that it takes; None for a number.
        result: size of the vector that it gives; None for a number.
        unit: of the result.
        kind: of the result.
        function: takes components and gives components, or says in the IR what they are; None where nobody
            loaded it.
        about: what it is, for messages.
        span: where its name was declared.
    """

    name: str
    arguments: tuple[int | None, ...]
    result: int | None
    unit: Unit
    kind: Kind
    function: Callable[..., Sequence[Any]] | ir.Body | None
    about: str = ""
    span: Span | None = None


Entry: TypeAlias = Known | Definition | External


@dataclass(frozen=True, slots=True)
class Scope:
    """Names and rules under which expressions are resolved.

    Attributes:
        entries: what the file knows, by name.
        sink: findings are appended here.
        error: what a public function raises: `SpecError`, or `SystemFileError` in a system file.
        samplers: `uniform(…)` and its like are allowed.
        temporal: temporal operators are allowed.
        time_unit: unit of bare numbers in intervals; "" where no pragma says so.
        facts: enforced ranges of columns, in stored units.
        elsewhere: names that only the system knows, with the advice to give.
        modules: what imported files know, by alias.
        product: `x in [lo, hi]` is `(x - lo) (hi - x)` (`@product`).
        locals: arguments of the macro and quantifier variables at hand, with what they cost.
    """

    entries: Mapping[str, Entry] = field(default_factory=dict)
    sink: list[Diagnostic] = field(default_factory=Findings)
    error: type[StlcError] = SpecError
    samplers: bool = False
    temporal: bool = False
    time_unit: str = ""
    facts: Mapping[str, Bounds] = field(default_factory=dict)
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    modules: Mapping[str, Scope] = field(default_factory=dict, compare=False)
    product: bool = False
    locals: Mapping[str, tuple[Value, Cost]] = field(default_factory=dict)
    meter: Meter = field(default_factory=Meter, compare=False, repr=False)
    cache: dict[str, tuple[Value, Cost] | None] = field(default_factory=dict, compare=False, repr=False)
    open: tuple[str, ...] = ()

    @property
    def in_spec(self) -> bool:
        """True if this is a specification, where `T`, `end` and `dt` are words of the language."""
        return not issubclass(self.error, SystemFileError)

    def extended(self, entries: Mapping[str, Entry], *, samplers: bool | None = None) -> Scope:
        """The same scope with more names; `samplers` changes whether random draws are allowed."""
        return replace(
            self,
            entries={**self.entries, **entries},
            samplers=self.samplers if samplers is None else samplers,
            cache={},
        )

    def as_products(self) -> Scope:
        """The same scope under `@product`, which definitions are looked at anew for."""
        broken = {name: None for name, value in self.cache.items() if value is None}
        modules = {alias: module.as_products() for alias, module in self.modules.items()}
        return replace(self, product=True, cache=dict(broken), modules=modules)

    def report(self, finding: Diagnostic) -> None:
        """Add a finding, once (a macro that is used twice has its faults once)."""
        tell(self.sink, finding)

    def fail(self, finding: Diagnostic) -> NoReturn:
        """Report and give up on the expression at hand."""
        self.report(finding)
        raise Failed

    def unknown(self, name: ast.Name, *, called: bool = False) -> NoReturn:
        """Report a name that nothing declares (E101)."""
        candidates = [*self.locals, *self.entries]
        if called:
            candidates += [*callable_names(), *(sampler_names() if self.samplers else ())]
        pairs = len(candidates) * (1 + len(self.sink))
        near = closest(name.name, candidates) if pairs <= _MAX_PAIRS else None
        what = "function" if called else "name"
        help_ = () if near is None else (f"did you mean `{near}`?{self._about(near)}",)
        if name.name in self.elsewhere:
            help_ = (self.elsewhere[name.name],)
        note = () if called or not self.in_spec else ("parameters never default to 0",)
        self.fail(Diagnostic("E101", f"unknown {what} `{name.name}`", name.span, help=help_, note=note))

    def _about(self, name: str) -> str:
        entry = self.entries.get(name)
        return f"  ({entry.about})" if entry is not None and entry.about else ""


def column_value(column: Column, origin: Origin | None = None) -> Number:
    """The number that a column holds, in SI units from the zero of its unit."""
    num: ir.Num = ir.Signal(column.name)
    if column.unit.ratio != 1:
        num = ir.Op("mul", (num, ir.Const(column.unit.scale)))
    flexible = column.kind in ("real", "int") and not column.unit.text
    return Number(num, column.unit, flexible, kind=column.kind, labels=column.labels, origin=origin)


def column_entries(
    columns: Iterable[Column], *, about: str = "", span: Span | None = None
) -> dict[str, Known]:
    """Entries for columns; `q[0]`, `q[1]`, … together become the vector `q`."""
    entries: dict[str, Known] = {}
    for column in columns:
        value = column_value(column)
        match = _COMPONENT.fullmatch(column.name)
        if match is None:
            entries[column.name] = Known(value, about, span)
            continue
        before = entries.get(match["name"])
        items = before.value.items if before is not None and isinstance(before.value, Vector) else ()
        entries[match["name"]] = Known(Vector((*items, value)), about, span)
    return entries


def member_entries(enums: Iterable[tuple[tuple[str, float], ...]]) -> dict[str, Known]:
    """Entries for the members of enums; a member of several enums is told apart by what it meets."""
    options: dict[str, list[tuple[tuple[str, float], ...]]] = {}
    for labels in dict.fromkeys(enums):
        for name, _ in labels:
            options.setdefault(name, []).append(labels)
    return {name: Known(EnumMember(name, tuple(found)), "enum member") for name, found in options.items()}


def constant_value(value: float, unit: Unit = DIMENSIONLESS) -> Number:
    """A number known in SI units; without a written unit it is as good as a bare one."""
    bare = not unit.text
    exact = Fraction(repr(value)) - unit.offset
    kind: Literal["int", "real"] = "int" if bare and exact.denominator == 1 else "real"
    return Number(ir.Const(nearest(exact)), unit, bare, bare, exact, kind)


def constant_entries(
    constants: Mapping[str, tuple[float, Unit]], *, about: str = "constant"
) -> dict[str, Known]:
    """Entries for constants given as (value in SI units, unit)."""
    return {name: Known(constant_value(value, unit), about) for name, (value, unit) in constants.items()}


def enforced(columns: Iterable[Column]) -> dict[str, Bounds]:
    """Ranges that are facts: clamped columns, booleans, enums, and whatever else is marked so."""
    facts: dict[str, Bounds] = {}
    for column in columns:
        if column.kind == "bool":
            facts[column.name] = (0.0, 1.0)
        elif column.labels:
            values = [value for _, value in column.labels]
            facts[column.name] = (min(values), max(values))
        elif column.fact and column.low is not None and column.high is not None:
            facts[column.name] = (column.low, column.high)
    return facts


def reserved(name: str) -> bool:
    """True if a call of `name` means a built-in function."""
    return name in (*callable_names(), *sampler_names())
