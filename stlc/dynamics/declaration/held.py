"""Sections `held` and `delay`: values computed at samples, as in a digital controller, and earlier ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from stlc.compile.frontend.scope import Known, column_value
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.columns import (
    RANGE,
    declared_columns,
    name_columns,
    read_ranges,
    unit_text,
)
from stlc.dynamics.declaration.motion import Assign, state_assigns
from stlc.dynamics.declaration.sampled import CLOCK, Sampled, clock, declared
from stlc.dynamics.declaration.schema.expressions import SECOND, written
from stlc.dynamics.declaration.schema.names import Context, base_name
from stlc.dynamics.declaration.schema.reader import first_line
from stlc.dynamics.declaration.schema.record import (
    EXPRESSION,
    FLAG,
    OF,
    STEPS,
    VECTOR,
    integer,
    key,
    raw,
    read,
    values_of,
)
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Node
from stlc.signature import Column
from stlc.source import Span
from stlc.units import Unit

MAX_DELAY = 1000
"""Largest delay in steps; each is a column of the state."""


@dataclass(repr=False, eq=False)
class HeldKeys:
    """The keys that the declaration of one held value may have."""

    value: Node | None = key(
        raw(VECTOR), "the value; `prev(…)` is a value at the sample before", required=True
    )
    every: int = key(STEPS, "time between samples; one step unless given", 1)
    before: Node | None = key(raw(VECTOR), "value before the start, for `prev(…)`")
    unit: Unit = key(unit_text, "unit of the stored numbers", Unit())
    ends: Node | None = key(RANGE, "lower and upper end, numbers or vectors", name="range")
    enum: Node | None = key(raw({"type": ["array", "object"]}), "members, by name or by name and value")
    boolean: bool = key(FLAG, "takes 0 and 1", False, name="bool")
    whole: bool = key(FLAG, "takes whole numbers", False, name="int")
    size: int | None = key(integer(high=1000), "components of a vector")


@dataclass(repr=False, eq=False)
class DelayKeys:
    """The keys that the declaration of one delayed value may have."""

    of: Node | None = key(raw(EXPRESSION), "the value that is delayed", required=True)
    by: Node | None = key(
        raw(EXPRESSION),
        "the delay, as a time or in steps; with `at_most`, a time that may change",
        required=True,
    )
    at_most: int | None = key(STEPS, "the longest delay, which makes `by` an expression of the state")
    transport: bool = key(FLAG, "the delay of a pipe, whose flow carries the value along", False)
    before: Node | None = key(
        raw(EXPRESSION), "value before the start; that of `of` at the start unless given"
    )
    unit: Unit = key(unit_text, "unit of the stored numbers", Unit())
    ends: Node | None = key(RANGE, "lower and upper end", name="range")


@dataclass(frozen=True, slots=True)
class DelayEntry:
    """One entry of the section `delay`.

    Attributes:
        entry: the entry in the file.
        keys: its keys.
        steps: the delay in steps, rounded up; the longest one if it varies.
    """

    entry: Entry
    keys: DelayKeys
    steps: int


@dataclass(frozen=True, slots=True)
class HeldSection:
    """The sections `held` and `delay`, of which only names and keys are read.

    Attributes:
        entries: the entries of the section `held`, each with its keys.
        delays: the entries of the section `delay`.
        ticks: the clock, if a value is not computed at every step.
    """

    entries: tuple[tuple[Entry, HeldKeys], ...] = ()
    delays: tuple[DelayEntry, ...] = ()
    ticks: Sampled = field(default_factory=Sampled)


def declare_held(node: Node | None, delay: Node | None, cx: Context) -> HeldSection:
    """Read the sections `held` (`node`) and `delay` except for the values, and declare their names."""
    delays = _declared_delays(delay, cx)
    found: list[tuple[Entry, HeldKeys]] = []
    for entry in cx.reader.entries(node, "`held`"):
        name = entry.key.text
        if not cx.names.declare(entry.key, "held value", cx.reader):
            continue
        where = f"the held value `{name}`"
        keys = HeldKeys(**values_of(HeldKeys, cx.plain, entry.value, where, OF))
        columns = declared_columns(name, keys, where, cx.plain)
        if keys.whole:
            columns = tuple(replace(each, kind="int") if each.kind == "real" else each for each in columns)
        cx.names.columns += columns
        cx.names.place_components(name, [column.name for column in columns])
        found.append((entry, keys))
    name_columns(cx.names, "held value")
    if node is None or all(keys.every == 1 for _, keys in found):
        return HeldSection(tuple(found), delays)
    return HeldSection(tuple(found), delays, clock(cx, first_line(node.span), flows=False))


def _declared_delays(node: Node | None, cx: Context) -> tuple[DelayEntry, ...]:
    """Read the section `delay` except for the values, and declare its names."""
    found: list[DelayEntry] = []
    for entry in cx.reader.entries(node, "`delay`"):
        name = entry.key.text
        if not cx.names.declare(entry.key, "delayed value", cx.reader):
            continue
        where = f"the delayed value `{name}`"
        keys = read(DelayKeys, cx.plain, entry.value, where, OF)
        ranges = read_ranges(keys.ends, keys.unit, 1, where, cx.plain)
        low, high = ranges[0] if ranges else (None, None)
        cx.names.columns.append(Column(name, keys.unit, low=low, high=high))
        varies = keys.at_most is not None
        if keys.transport and not varies:
            cx.reader.report("S102", f"{where} needs its longest delay", entry.key.span, "at_most: 1 s")
            continue
        steps = keys.at_most
        if steps is None and keys.by is not None:
            steps = STEPS.read(cx.plain, keys.by, f"`by` of {where}")
        if steps is not None and steps > MAX_DELAY:
            message = f"{where} is {steps} steps late, and {MAX_DELAY} are the most"
            cx.reader.report("S103", message, entry.place("at_most" if varies else "by"))
        elif steps is not None:
            found.append(DelayEntry(entry, keys, steps))
    return tuple(found)


def read_held(section: HeldSection, cx: Context) -> Sampled:
    """Read the values of the sections `held` and `delay`.

    The columns that keep earlier values for `prev(…)` are declared.
    """
    sampled = {
        each.name: Known(column_value(each), "input signal")
        for each in cx.names.columns
        if each.role == "env"
    }
    here = cx.here.extended(sampled)
    inside = replace(cx, here=replace(here, scope=replace(here.scope, earlier=True)))
    cells: dict[str, _Held] = {}
    for entry, keys in section.entries:
        cells |= {each.column.name: each for each in _cells(entry, keys, inside, cx)}
    late: tuple[str, ...] = ()
    flow: tuple[Assign, ...] = ()
    for delay in section.delays:
        parts = _delayed(delay, replace(cx, here=here))
        cells |= {each.column.name: each for each in parts.cells}
        late, flow = late + parts.hidden, flow + parts.flow
    cells = {name: _without_controls(cell, cx) for name, cell in cells.items()}
    past = _Past(cells, cx)
    initial = tuple(Assign(name, past.at_start(cell), cell.text) for name, cell in cells.items())
    updates = tuple(Assign(name, past.later(cell), cell.text) for name, cell in cells.items())
    return section.ticks + Sampled((), initial, updates, flow, late) + past.kept()


def _without_controls(cell: _Held, cx: Context) -> _Held:
    """Return a column whose value depends on no control; if it does, report S202, and return a constant.

    Values are computed before controls are chosen.
    """
    read = cell.value.columns | (frozenset() if cell.before is None else cell.before.columns)
    found = {control.name for control in cx.names.controls} & {name.split(ir.BEFORE)[0] for name in read}
    if not found:
        return cell
    message = f"`{base_name(cell.column.name)}` is computed before the control `{min(found)}` is chosen"
    cx.reader.report("S202", message, cell.span, "read the control in `flow`")
    return replace(cell, value=ir.Const(0.0), before=None)


@dataclass(frozen=True, slots=True)
class _Held:
    """One column of the section `held`.

    Attributes:
        column: the column.
        every: steps between samples.
        value: its value at a sample. A name with `ir.BEFORE` is a value at the sample before.
        text: source text of the value.
        before: its value before the start, as an expression of the initial states; None if it is not given.
        span: location of its declaration.
    """

    column: Column
    every: int
    value: ir.Num
    text: str
    before: ir.Num | None
    span: Span


def _cells(entry: Entry, keys: HeldKeys, inside: Context, cx: Context) -> list[_Held]:
    """Read the value of one declaration, one column per component.

    `inside` is the context of values, in which `prev(…)` is known; `cx` is that of other expressions.
    """
    if keys.value is None:
        return []
    values = state_assigns(Entry(entry.key, keys.value), "`held`", inside)
    started = () if keys.before is None else state_assigns(Entry(entry.key, keys.before), "`before`", cx)
    before = {assign.name: assign.value for assign in started}
    columns = {column.name: column for column in cx.names.group(entry.key.text)}
    return [
        _Held(columns[each.name], keys.every, each.value, each.text, before.get(each.name), entry.key.span)
        for each in values
    ]


@dataclass(frozen=True, slots=True)
class _Delayed:
    """The columns of one delay.

    Attributes:
        cells: columns that are computed at samples; the last one is the delayed value.
        flow: the derivative of the delayed value within a step, if the delay varies.
    """

    cells: tuple[_Held, ...] = ()
    flow: tuple[Assign, ...] = ()

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of the columns that policies do not observe: all but the delayed value."""
        return tuple(each.column.name for each in self.cells[:-1])


def _delayed(delay: DelayEntry, cx: Context) -> _Delayed:
    """Read one delay, and declare the columns that it needs; it has none if the declaration is invalid."""
    name, place, keys = delay.entry.key.text, delay.entry.key.span, delay.keys
    where = f"the delayed value `{name}`"
    value = cx.here.stored(keys.of, where, keys.unit)
    before = value if keys.before is None else cx.here.stored(keys.before, f"`before` of {where}", keys.unit)
    if value is None or before is None:
        return _Delayed()
    (column,) = cx.names.group(name)
    present = _Held(replace(column, name=f"{name}_now"), 1, value, written(keys.of), before, place)
    if keys.at_most is not None:
        return _varying(delay, column, present, cx)
    declared(cx, present.column, place)
    late = ir.Signal(present.column.name + ir.BEFORE * delay.steps)
    text = f"{present.text}, {delay.steps} samples ago"
    return _Delayed((present, _Held(column, 1, late, text, before, place)))


def _varying(delay: DelayEntry, column: Column, present: _Held, cx: Context) -> _Delayed:
    """Return the columns of a delay that varies; `present` is the value without the delay.

    Within a step the delayed value moves evenly to the one at the next sample, which follows from samples
    that are known, because the delay is at least one step.
    """
    keys, place = delay.keys, delay.entry.key.span
    by = cx.here.stored(keys.by, f"`by` of the delayed value `{column.name}`", SECOND)
    if by is None:
        return _Delayed()
    dt = float(cx.dt)
    wait = by.apply("clip", dt, delay.steps * dt)
    text = f"{present.text}, {written(keys.by)} ago"
    share: ir.Num = ir.Op("div", (ir.Const(dt), wait) if keys.transport else (wait, ir.Const(dt)))
    rate = _Held(
        Column(f"{column.name}_share", Unit()), 1, share, f"{written(keys.by)} and the step", share, place
    )
    count = delay.steps if keys.transport else 0
    read = (*_ago(present, delay.steps), *_ago(rate, count))
    body = _pipe(delay.steps) if keys.transport else _earlier(delay.steps)
    late, soon = body.calls_of(f"{column.name}_late", read)
    slope: ir.Num = (soon - late) * (1.0 / dt)
    moves = replace(
        column, name=f"{column.name}_rate", unit=column.unit.interval / SECOND, low=None, high=None
    )
    cells = (
        present,
        rate,
        _Held(moves, 1, slope, f"slope of {column.name}", None, place),
        _Held(column, 1, late, text, present.before, place),
    )
    for cell in cells[:-1]:
        declared(cx, cell.column, place)
    rates = () if cx.discrete else (Assign(column.name, ir.Signal(moves.name), moves.name),)
    return _Delayed(cells, rates)


def _ago(cell: _Held, steps: int) -> tuple[ir.Num, ...]:
    """Return a value at a sample, and at each of so many samples before it."""
    return tuple(ir.Signal(cell.column.name + ir.BEFORE * back) for back in range(steps + 1))


def _earlier(steps: int) -> ir.Body:
    """Return the delayed value, and the one at the next sample, of a delay that is given as a time.

    The arguments are the value at a sample, at each of `steps` samples before it, and the delay in steps.
    """
    ways = [(ir.Const(float(k)), ir.Const(1.0)) for k in range(steps)]
    at = ir.Signal("by")
    targets = (at, at - 1.0)
    outputs = tuple(_between(ways, target) for target in targets)
    return ir.Body((*_values(steps), "by"), (), outputs)


def _pipe(steps: int) -> ir.Body:
    """Return the delayed value, and the one at the next sample, of a transport delay.

    The value that leaves a pipe of length 1 at time t entered it at s, where the integral of 1 / D over
    [s, t] is 1: D is the time that the flow at an instant needs for the whole pipe. The arguments are the
    value at a sample and at each of `steps` samples before it, and likewise the way per step, in lengths.
    """
    speeds = tuple(f"speed{k}" for k in range(steps + 1))
    lets: list[tuple[str, ir.Num]] = []
    ways: list[tuple[ir.Num, ir.Num]] = []
    passed: ir.Num = ir.Const(0.0)
    for k, pair in enumerate(pairwise(speeds)):
        lets.append((f"way{k}", 0.5 * (ir.Signal(pair[0]) + ir.Signal(pair[1]))))
        ways.append((passed, ir.Signal(f"way{k}")))
        lets.append((f"passed{k}", ways[-1][0] + ways[-1][1]))
        passed = ir.Signal(f"passed{k}")
    soon = 1.0 - ir.Signal(speeds[0])
    outputs = tuple(_between(ways, target) for target in (ir.Const(1.0), soon))
    return ir.Body((*_values(steps), *speeds), tuple(lets), outputs)


def _values(steps: int) -> tuple[str, ...]:
    """Names of the value at a sample, and at each of so many samples before it."""
    return tuple(f"value{k}" for k in range(steps + 1))


def _between(ways: Sequence[tuple[ir.Num, ir.Num]], at: ir.Num) -> ir.Num:
    """Return the value at the way `at` before a sample, linear between samples.

    `ways` has the way to each sample, and from there to the one before.
    """
    values = [ir.Signal(name) for name in _values(len(ways))]
    parts: list[ir.Num] = [values[0]]
    for (passed, way), (later, earlier) in zip(ways, pairwise(values), strict=True):
        share: ir.Num = at - passed
        if way != ir.Const(1.0):
            share = share / way
        rise = earlier - later
        parts.append(rise * share.apply("clip", 0.0, 1.0))
    return ir.Num.total(parts)


class _Past:
    """Earlier values that held values read by `prev(…)`, and the columns that keep them.

    Attributes:
        cells: the columns of the section `held`, by name.
        kept_samples: (steps between samples, name of a column) -> number of samples that are kept.
    """

    def __init__(self, cells: Mapping[str, _Held], cx: Context) -> None:
        self.cells = cells
        self.kept_samples: dict[tuple[int, str], int] = {}
        self._cx = cx

    def at_start(self, cell: _Held) -> ir.Num:
        """Value of a column at the first sample, as an expression of the initial states."""

        def read(leaf: ir.Num) -> ir.Num:
            name, back = _earlier_name(leaf)
            return self._before(name, cell) if back else leaf

        return cell.value.map_leaves(read)

    def later(self, cell: _Held) -> ir.Num:
        """Value of a column at a later sample."""

        def read(leaf: ir.Num) -> ir.Num:
            name, back = _earlier_name(leaf)
            return self._earlier(name, back, cell) if back else leaf

        return _ticking(cell.every, cell.value.map_leaves(read), cell.column.name)

    def _own(self, every: int, name: str) -> bool:
        """True if the column `name` is held with the same period, so that it is its own latest value."""
        return name in self.cells and self.cells[name].every == every

    def _earlier(self, name: str, back: int, cell: _Held) -> ir.Num:
        """The value that the column `name` had `back` samples of `cell` ago, as an expression."""
        back -= self._own(cell.every, name)
        if back == 0:
            return ir.Signal(name + ir.BEFORE)
        chain = cell.every, name
        self.kept_samples[chain] = max(back, self.kept_samples.get(chain, 0))
        return ir.Signal(_kept_name(*chain, back) + ir.BEFORE)

    def _before(self, name: str, reader: _Held | None = None) -> ir.Num:
        """Value of a column before the start: `before` of a held value, the initial value of a state.

        S102 is reported if `reader`, a held value, needs it and it is not given.
        """
        cell = self.cells.get(name)
        if cell is None:
            return ir.Signal(name)
        if cell.before is None and reader is not None:
            message = f"`prev({name})` has no value before the start"
            self._cx.reader.report("S102", message, cell.span, f"{base_name(name)}: {{before: 0}}")
        return ir.Const(0.0) if cell.before is None else cell.before

    def kept(self) -> Sampled:
        """Declare the columns that keep earlier values; return how they are computed."""
        found = Sampled()
        for (every, name), count in self.kept_samples.items():
            own = self._own(every, name)
            column = next(each for each in self._cx.names.columns if each.name == name)
            place = self._cx.names.places.get(base_name(name)) or self._cx.names.places[name]
            start, value = (self._before(name), name + ir.BEFORE) if own else (ir.Signal(name), name)
            for back in range(1, count + 1):
                kept = _kept_name(every, name, back)
                declared(self._cx, replace(column, name=kept, role="state"), place)
                text = f"{name}, {back} samples ago"
                first, later = Assign(kept, start, text), _ticking(every, ir.Signal(value), kept)
                found += Sampled((), (first,), (Assign(kept, later, text),), (), (kept,))
                start, value = self._before(name), kept + ir.BEFORE
        return found


def _earlier_name(leaf: ir.Num) -> tuple[str, int]:
    """Return the name of a column, and how many times `prev(…)` is applied to it, for a leaf of a value."""
    name, *befores = leaf.name.split(ir.BEFORE) if isinstance(leaf, ir.Signal) else ("",)
    return name, len(befores)


def _kept_name(every: int, name: str, back: int) -> str:
    """Name of the column that keeps the value of a column some samples ago."""
    stem = name.replace("[", "_").replace("]", "")
    return f"{stem}_{back}_ago" if every == 1 else f"{stem}_{back}_ago_of_{every}"


def _ticking(every: int, value: ir.Num, name: str) -> ir.Num:
    """Return `value` at every so many steps, and otherwise the present value of the column `name`."""
    if every == 1:
        return value
    rest = ir.Signal(CLOCK) % float(every)
    due = ir.Predicate(0.5 - rest)
    return due.select(value, ir.Signal(name + ir.BEFORE))
