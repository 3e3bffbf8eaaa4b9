"""Section `init`: distribution of initial states.

The distribution is a mixture of situations, a grid, or a file. A situation is one of several ways to draw a
state.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as MappingType
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

from stlc.compile.frontend.scope import Entry as Name
from stlc.compile.frontend.scope import Known
from stlc.compile.frontend.values import Number, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.motion import Assign, column_assign, shared_draws, state_assigns, states_of
from stlc.dynamics.declaration.schema.expressions import written
from stlc.dynamics.declaration.schema.names import Context, base_name, component_names
from stlc.dynamics.declaration.schema.reader import first_line
from stlc.dynamics.declaration.schema.record import (
    EXPRESSION,
    NAME,
    OF,
    VECTOR,
    integer,
    items_of,
    key,
    list_of,
    mapping_of,
    number,
    raw,
    read,
    section,
)
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Mapping, Node, Sequence
from stlc.files import named_in
from stlc.signature import Column
from stlc.source import Span

MAX_COUNT = 1_000_000

_DRAWS = raw(mapping_of(VECTOR))


@dataclass(frozen=True, slots=True)
class GridDecl:
    """Grid of initial states, with one axis per column.

    An axis is a pair: the name of the column, and its values in the unit of the column. Every combination of
    values, one from each axis, is a possible state.
    """

    axes: tuple[tuple[str, tuple[float, ...]], ...]


@dataclass(frozen=True, slots=True)
class FileDecl:
    """Initial states from a file with one array for each of `columns`; every sample is a possible state."""

    path: Path
    columns: tuple[Column, ...]
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Situation:
    """One of several ways to draw an initial state.

    The assignments `draws` give values to states. If there are branches, one of them gives the other values.

    Attributes:
        name: for messages and tables; "" for an unnamed branch.
        weight: probability of this situation relative to the alternatives; the weights need not sum to 1.
        draws: assignments in order; later ones may read earlier ones. Names that are not columns are local.
        branches: alternative situations. After `draws`, one of them is drawn by weight. May be empty.
        points: grid or file, from which a state is drawn before `draws`; None if the situation has neither.
    """

    name: str
    weight: float
    draws: tuple[Assign, ...]
    branches: tuple[Situation, ...] = ()
    points: GridDecl | FileDecl | None = None


@dataclass(frozen=True, slots=True)
class InitDecl:
    """Distribution of initial states: a mixture of situations (alternative ways to draw a state).

    Attributes:
        mixture: the situations; for every state one of them is drawn by weight.
        where: conditions that every state must meet; other states are rejected.
        where_text: source text of these conditions.
        params: distributions of the parameters. They are drawn first; a situation may draw a parameter again.
        override: assignments drawn last, which replace the values that situations draw.
        computed: assignments made after all draws, of columns that follow from the others.
        span: source location of the section, for messages.
    """

    mixture: tuple[Situation, ...]
    where: tuple[ir.Formula, ...] = ()
    where_text: tuple[str, ...] = field(default=(), compare=False)
    params: tuple[Assign, ...] = ()
    override: tuple[Assign, ...] = ()
    span: Span | None = field(default=None, compare=False, repr=False)
    computed: tuple[Assign, ...] = field(default=(), repr=False)


@dataclass(repr=False, eq=False)
class SituationKeys:
    """The keys of a situation and of each of its branches."""

    name: str = key(NAME, "for messages and tables", "", label=OF)
    weight: float = key(number(), "share among its siblings, not normalised", 1.0)
    draw: Node | None = key(_DRAWS, "initial values of states, in order")
    choose: Node | None = key(raw({"type": ["array", "null"]}), "branches, of which one is drawn")
    let: Node | None = key(_DRAWS, "local names")
    also: Node | None = key(_DRAWS, "further values, in place of those of `draw`")


@dataclass(repr=False, eq=False)
class InitKeys:
    """The keys of the section `init`."""

    mixture: tuple[Node, ...] = key(list_of(section(SituationKeys), ""), "situations", ())
    where: Node | None = key(raw(items_of(EXPRESSION)), "conditions on every initial state")
    grid: Node | None = key(raw({"type": "object"}), "values of states; every combination equally often")
    from_: Node | None = key(raw({"type": "string"}), "a file of states, relative to this one", name="from")
    draw: Node | None = key(_DRAWS, "values of the states that `grid` or `from` leave out")
    let: Node | None = key(_DRAWS, "local names for `draw`")


@dataclass(repr=False, eq=False)
class AxisKeys:
    """The keys of evenly spaced values along one axis of a grid."""

    from_: Node | None = key(raw(EXPRESSION), "first value", name="from", required=True)
    to: Node | None = key(raw(EXPRESSION), "last value", required=True)
    count: int | None = key(integer(2, MAX_COUNT), "number of values", label=OF, required=True)


# ------------------------------------------------------------------------------ situations


def read_init(
    node: Node | None, cx: Context, params: tuple[Assign, ...] = (), computed: tuple[Assign, ...] = ()
) -> InitDecl:
    """Read the section `init`.

    The assignments `params` (distributions of parameters) are drawn first. Those in `computed` are made last;
    they give the columns that follow from the drawn ones.
    """
    reader = cx.reader
    if node is None:
        advice = "init: {mixture: [{draw: {x: 0}}]}"
        reader.report("S102", "the file lacks `init`", reader.source.span(0, 1), advice)
        return InitDecl(())
    keys = read(InitKeys, cx, node, "`init`")
    written_keys = {each.key.text for each in node.entries} if isinstance(node, Mapping) else set()
    given = [name for name in ("mixture", "grid", "from") if name in written_keys]
    if len(given) > 1:
        message = f"`init` takes one of `mixture`, `grid` and `from`, not {len(given)}"
        reader.report("S102", message, first_line(node.span))
    draws = _Draws(
        cx, frozenset(assign.name for assign in params), computed=frozenset(each.name for each in computed)
    )
    if "mixture" in given or not given:
        for name, value in (("draw", keys.draw), ("let", keys.let)):
            if value is not None:
                reader.report("S102", f"`{name}` under `init` goes with `grid` or `from`", value.span)
        if not keys.mixture:
            message, advice = "`init` lacks a `mixture` of situations", "mixture: [{draw: {x: 0}}]"
            reader.report("S102", message, first_line(node.span), advice)
        mixture = _mixture(keys.mixture, draws)
    else:
        mixture = (_given(keys, node, draws),)
    items = reader.items(keys.where, "`where`")
    formulas = [cx.here.formula(item, "a line of `where`") for item in items]
    span = node.span if keys.where is None else keys.where.span
    where = tuple(each for each in formulas if each is not None)
    texts = tuple(map(written, items))
    return InitDecl(mixture, where, texts, params, span=first_line(span), computed=computed)


def _mixture(items: tuple[Node, ...], outer: _Draws) -> tuple[Situation, ...]:
    """Read the situations of a mixture (alternative ways to draw an initial state).

    S103 is reported if all weights are 0. `outer` holds the assignments made before a situation is drawn; a
    situation may read their names.
    """
    situations = [_situation(item, outer) for item in items]
    if items and not any(situation.weight > 0 for situation in situations):
        outer.cx.reader.report("S103", "the weights of a mixture are all 0", first_line(items[0].span))
    return tuple(situations)


def _situation(node: Node, outer: _Draws) -> Situation:
    """Read one situation (a way to draw an initial state), or one of its branches.

    `outer` holds the assignments made before the situation is drawn; the situation may read their names.
    """
    keys = read(SituationKeys, outer.cx, node, "a situation")
    draws = _Draws(outer.cx, outer.ready, outer.locals, outer.computed)
    draws.read(keys)
    choices = outer.cx.reader.items(keys.choose, "`choose`")
    branches = _mixture(choices, draws)
    if not choices and isinstance(node, Mapping):
        draws.require_all(f"the situation `{keys.name}`" if keys.name else "this situation", node)
    return Situation(keys.name, keys.weight, tuple(draws.found), branches)


class _Draws:
    """Reader of the assignments of one situation (a way to draw an initial state), in drawing order.

    The assignment of a local name (from `let`) is placed before the first assignment that reads the name.

    Attributes:
        found: the assignments read, in the order in which they are drawn.
        ready: columns, and components of local names, that already have a value.
        locals: local names that already have a value.
        computed: columns that are not drawn, since they follow from the others.
    """

    def __init__(
        self,
        cx: Context,
        ready: frozenset[str],
        known: MappingType[str, Name] = MappingProxyType({}),
        computed: frozenset[str] = frozenset(),
    ) -> None:
        self.cx = cx
        self.found: list[Assign] = []
        self.failed = False
        self.ready = ready
        self.locals = dict(known)
        self.computed = computed
        self.unresolved: dict[str, Node] = {}

    @property
    def drawing(self) -> Context:
        """Context in which random expressions are read; they may use only names that already have a value."""
        return self.cx.drawing(self.locals, self.ready)

    def require_all(self, called: str, node: Node) -> None:
        """Report S102 if a state has no initial value.

        The message is located at `node` and begins with `called`, such as "this situation".
        """
        known = self.ready | self.computed
        undrawn = [column.name for column in self.cx.names.columns if column.name not in known]
        missing = list(dict.fromkeys(map(base_name, undrawn)))
        if missing and not self.failed:
            listed = ", ".join(f"`{column}`" for column in missing)
            message = f"{called} draws no value for {listed}"
            self.cx.reader.report("S102", message, first_line(node.span), "every state needs a first value")

    def read(self, keys: SituationKeys | InitKeys) -> None:
        """Read the entries `let`, `draw` and `also`, and append their assignments to `found`.

        The assignment of a local name (from `let`) is placed before the first assignment that reads the name.
        """
        reader = self.cx.reader
        before = len(reader.findings)
        for entry in reader.entries(keys.let, "`let`"):
            if entry.key.text in self.cx.names.places:
                message = f"`{entry.key.text}` is already the name of something"
                reader.report("E102", message, entry.key.span)
            else:
                self.unresolved[entry.key.text] = entry.value
        also_node = keys.also if isinstance(keys, SituationKeys) else None
        also = {entry.key.text: entry for entry in reader.entries(also_node, "`also`")}
        for entry in reader.entries(keys.draw, "`draw`"):
            self._draw(also.pop(entry.key.text, entry), "`draw`")
        for entry in also.values():
            self._draw(entry, "`also`")
        for name in list(self.unresolved):
            self._let(name)
        self.failed = len(reader.findings) > before

    def _draw(self, entry: Entry, where: str) -> None:
        """Append to `found` the assignments that draw the initial value of one state (`entry`).

        `where` names the section in messages.
        """
        columns = states_of(entry, where, self.cx)
        if not columns:
            return
        if any(column.name in self.computed for column in columns):
            name = entry.key.text
            message = f"`{name}` follows from the other states, and cannot be drawn"
            near = f"{name}_values"
            advice = f"draw `{near}`" if near in self.cx.names.places else ""
            self.cx.reader.report("S202", message, entry.key.span, advice)
            return
        self._needed(entry.value)
        self.found.extend(shared_draws(state_assigns(entry, where, self.drawing)))
        self.ready |= {column.name for column in columns}

    def _needed(self, node: Node) -> None:
        """Append to `found` the assignments of the local names (from `let`) that `node` reads."""
        texts = [written(item) for item in (node.items if isinstance(node, Sequence) else (node,))]
        for name in list(self.unresolved):
            if any(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text) for text in texts):
                self._let(name)

    def _let(self, name: str) -> None:
        """Append to `found` the assignment of the local name `name` (from `let`).

        If the value of `name` reads other local names, the assignments of these names are appended first.
        """
        if name not in self.unresolved:
            return
        node = self.unresolved.pop(name)
        self._needed(node)
        numbers = self.drawing.here.numbers(node, f"`{name}`")
        known: Number | VectorValue = Number(ir.Const(0.0), flexible=True)
        if numbers is not None:
            vector = len(numbers) > 1 or isinstance(node, Sequence)
            called = component_names(name, len(numbers) if vector else None)
            pairs = list(zip(called, numbers, strict=True))
            self.found.extend(shared_draws([Assign(each, num.num, written(node)) for each, num in pairs]))
            items = tuple(
                replace(number, num=ir.Signal(each), exact=None, span=None, origin=None)
                for each, number in pairs
            )
            known = VectorValue(items) if vector else items[0]
            self.ready |= set(called)
        self.locals[name] = Known(known, "local name")


# ---------------------------------------------------------------------------- given states


def _given(keys: InitKeys, node: Node, draws: _Draws) -> Situation:
    """Read initial states from a grid or a file, as one situation (a way to draw an initial state).

    States that the grid or the file does not contain must be given by `draw`; a missing one is reported as
    S102. `node` is the location of the message.
    """
    cx = draws.cx
    rest = {entry.key.text for entry in cx.reader.entries(keys.draw, "`draw`")}
    missing = [
        column
        for column in cx.names.columns
        if column.name not in draws.ready | draws.computed
        and not {column.name, base_name(column.name)} & rest
    ]
    points: GridDecl | FileDecl | None
    if keys.grid is not None:
        points = _grid(keys.grid, cx)
        draws.ready |= {name for name, _ in points.axes}
    else:
        assert keys.from_ is not None
        points = _file(keys.from_, tuple(missing), cx)
        draws.ready |= {column.name for column in missing}
    draws.read(keys)
    draws.require_all("the grid", node)
    return Situation("grid" if keys.grid is not None else "from", 1.0, tuple(draws.found), (), points)


def _grid(node: Node, cx: Context) -> GridDecl:
    """Read a grid such as `{x: {from: -1, to: 1, count: 21}, sign: [stop, light]}`.

    The grid consists of every combination of the values.
    """
    axes = []
    for entry in cx.reader.entries(node, "`grid`"):
        columns = states_of(entry, "`grid`", cx)
        if columns and cx.names.vector(entry.key.text):
            advice = f'"{columns[0].name}": …'
            cx.reader.report("S203", f"`{entry.key.text}` is a vector", entry.key.span, advice)
        elif columns:
            axes.append((columns[0].name, _values(columns[0], entry, cx)))
    if not axes:
        cx.reader.wrong(node, "`grid`", "states and their values", "{x: {from: -1, to: 1, count: 21}}")
    return GridDecl(tuple(axes))


def _values(column: Column, entry: Entry, cx: Context) -> tuple[float, ...]:
    """Return the values of a column along its axis of the grid, in the unit of the column.

    `entry` gives them as a list or as evenly spaced values. An invalid value is reported and becomes 0.
    """
    where = f"the values of `{column.name}`"
    if isinstance(entry.value, Mapping):
        return _spaced(column, entry.value, where, cx)
    single = not isinstance(entry.value, Sequence)
    items = (entry.value,) if single else cx.reader.items(entry.value, where)
    if not items:
        cx.reader.wrong(entry.value, where, "a list of at least one value")
    found = []
    for item in items:
        assign = column_assign(column, item, cx)
        if assign is not None and not isinstance(assign.value, ir.Const):
            cx.reader.wrong(item, f"a value of `{column.name}`", "a constant", "draw it under `draw`")
        found.append(assign.value.value if assign is not None and isinstance(assign.value, ir.Const) else 0.0)
    return tuple(found) or (0.0,)


def _spaced(column: Column, node: Mapping, where: str, cx: Context) -> tuple[float, ...]:
    """Read `{from: 0, to: 1, count: 5}`: evenly spaced values of a column, including both ends.

    If a key is missing or invalid, the only value is 0. `where` names the axis in messages.
    """
    keys = read(AxisKeys, cx, node, where)
    low = cx.here.constant(keys.from_, f"`from` of {where}", column.unit)
    high = cx.here.constant(keys.to, f"`to` of {where}", column.unit)
    if column.kind != "real":
        cx.reader.wrong(node, where, "a list of its members")
    if low is None or high is None or keys.count is None:
        return (0.0,)
    return tuple(low + (high - low) * index / (keys.count - 1) for index in range(keys.count))


def _file(node: Node, columns: tuple[Column, ...], cx: Context) -> FileDecl | None:
    """Read the path of a file of initial states, relative to the system file.

    `columns` are those whose values the file gives. Returns None if the path is not a text.
    """
    text = cx.reader.text(node, "`from`")
    if text is None:
        return None
    from stlc.trace.formats.registry import suffixes

    if Path(text).suffix.lower() not in (known := suffixes()):
        cx.reader.wrong(node, "`from`", "a file of states", f"formats: {', '.join(known)}")
    return FileDecl(named_in(node.span.source, text, copied=True), columns, node.span)
