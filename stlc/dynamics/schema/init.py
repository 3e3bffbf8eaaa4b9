"""Initial states: situations, branches, local names, conditions."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from stlc.compile.frontend.scope import Entry as Name
from stlc.compile.frontend.scope import Known
from stlc.compile.frontend.values import Number, Vector
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.init import FileDecl, GridDecl, InitDecl, Situation
from stlc.dynamics.declaration.model import Assign
from stlc.dynamics.init.shared_draws import shared_draws
from stlc.dynamics.schema.expressions import Expressions, written
from stlc.dynamics.schema.flow import state_assigns, states_of
from stlc.dynamics.schema.names import Names, base_name, component_names
from stlc.dynamics.schema.points import read_file, read_grid
from stlc.dynamics.schema.reader import Reader, first_line
from stlc.dynamics.schema.yaml_nodes import Entry, Mapping, Node, Sequence

INIT_KEYS = ("mixture", "where", "grid", "from", "draw", "let")
SITUATION_KEYS = ("name", "weight", "draw", "choose", "let", "also")


@dataclass(frozen=True, slots=True)
class _Drawn:
    """What has a value at some point of a situation: states, and local names with their numbers."""

    states: frozenset[str] = frozenset()
    locals: tuple[tuple[str, Number | Vector], ...] = ()

    def expressions(self, names: Names, reader: Reader) -> Expressions:
        """Expressions that may draw, and read what has a value."""
        entries: dict[str, Name] = {name: Known(number, "local name") for name, number in self.locals}
        ready = self.states | {name for local, value in self.locals for name in _columns_of(local, value)}
        return names.expressions(reader).extended(entries, samplers=True, ready=ready)


def _columns_of(name: str, value: Number | Vector) -> tuple[str, ...]:
    return component_names(name, len(value.items) if isinstance(value, Vector) else None)


def read_init(node: Node | None, reader: Reader, names: Names, params: tuple[Assign, ...] = ()) -> InitDecl:
    """The section `init`; `params` are drawn before everything else."""
    if node is None:
        reader.report(
            "S102", "the file lacks `init`", reader.source.span(0, 1), "init: {mixture: [{draw: {x: 0}}]}"
        )
        return InitDecl(())
    found = reader.fields(node, "`init`", INIT_KEYS)
    given = [key for key in ("mixture", "grid", "from") if key in found]
    if len(given) > 1:
        reader.report(
            "S102",
            f"`init` takes one of `mixture`, `grid` and `from`, not {len(given)}",
            first_line(node.span),
        )
    drawn = _Drawn(frozenset(assign.name for assign in params))
    if "mixture" in given or not given:
        mixture = _situations(found, node, drawn, reader, names)
    else:
        mixture = (_known(found, node, drawn, names.expressions(reader), names),)
    where, texts = _conditions(found.get("where"), names.expressions(reader))
    span = found["where"].span if "where" in found else node.span
    return InitDecl(mixture, where, texts, params, span=first_line(span))


def _situations(
    found: dict[str, Node], node: Node, drawn: _Drawn, reader: Reader, names: Names
) -> tuple[Situation, ...]:
    """The situations under `mixture`."""
    items = reader.items(found.get("mixture"), "`mixture`")
    for key in ("draw", "let"):
        if key in found:
            reader.report("S102", f"`{key}` under `init` goes with `grid` or `from`", found[key].span)
    if not items:
        reader.report(
            "S102",
            "`init` lacks a `mixture` of situations",
            first_line(node.span),
            "mixture: [{draw: {x: 0}}]",
        )
    return _mixture(items, drawn, reader, names)


def _known(found: dict[str, Node], node: Node, drawn: _Drawn, here: Expressions, names: Names) -> Situation:
    """One situation whose states, as far as it does not draw them, are those of a grid or a file."""
    reader = here.reader
    rest = {entry.key.text for entry in reader.entries(found.get("draw"), "`draw`")}
    missing = [
        column.name
        for column in names.columns
        if column.name not in drawn.states and not {column.name, base_name(column.name)} & rest
    ]
    points: GridDecl | FileDecl | None
    if "grid" in found:
        points = read_grid(found["grid"], here, names)
        taken = {name for name, _ in points.axes}
    else:
        points = read_file(found["from"], tuple(missing), reader)
        taken = set(missing)
    draws = _Draws(reader, names, replace(drawn, states=drawn.states | taken))
    draws.read(found)
    _all_drawn("the grid", draws, node, reader, names)
    return Situation("grid" if "grid" in found else "from", 1.0, tuple(draws.found), (), points)


def _conditions(node: Node | None, here: Expressions) -> tuple[tuple[ir.Formula, ...], tuple[str, ...]]:
    """The lines of `where`."""
    items = here.reader.items(node, "`where`")
    formulas = [here.formula(item, "a line of `where`") for item in items]
    return tuple(f for f in formulas if f is not None), tuple(written(item) for item in items)


def _mixture(items: tuple[Node, ...], drawn: _Drawn, reader: Reader, names: Names) -> tuple[Situation, ...]:
    """Situations, with weights that are not all 0."""
    situations = [_situation(item, drawn, reader, names) for item in items]
    if items and not any(situation.weight > 0 for situation in situations):
        reader.report("S103", "the weights of a mixture are all 0", first_line(items[0].span))
    return tuple(situations)


def _situation(node: Node, drawn: _Drawn, reader: Reader, names: Names) -> Situation:
    """One situation, or one branch of one."""
    found = reader.fields(node, "a situation", SITUATION_KEYS)
    name = reader.name(found.get("name"), "`name` of a situation") or ""
    weight = reader.number(found.get("weight"), "`weight`")
    draws = _Draws(reader, names, drawn)
    draws.read(found)
    choices = reader.items(found.get("choose"), "`choose`")
    branches = _mixture(choices, draws.drawn, reader, names)
    if not choices and isinstance(node, Mapping):
        _all_drawn(f"the situation `{name}`" if name else "this situation", draws, node, reader, names)
    return Situation(name, 1.0 if weight is None else weight, tuple(draws.found), branches)


def _all_drawn(called: str, draws: _Draws, node: Node, reader: Reader, names: Names) -> None:
    """Report states that have no first value."""
    undrawn = [column.name for column in names.columns if column.name not in draws.drawn.states]
    missing = list(dict.fromkeys(map(base_name, undrawn)))
    if missing and not draws.failed:
        listed = ", ".join(f"`{column}`" for column in missing)
        reader.report(
            "S102",
            f"{called} draws no value for {listed}",
            first_line(node.span),
            "every state needs a first value",
        )


class _Draws:
    """Reads the assignments of one situation; local names are worked out when they are first needed."""

    def __init__(self, reader: Reader, names: Names, drawn: _Drawn) -> None:
        self.reader = reader
        self.names = names
        self.drawn = drawn
        self.found: list[Assign] = []
        self.failed = False
        self.lets: dict[str, Node] = {}

    def read(self, found: dict[str, Node]) -> None:
        """`let`, `draw` and `also`, in the order in which they can be worked out."""
        before = len(self.reader.findings)
        self._read(found)
        self.failed = len(self.reader.findings) > before

    def _read(self, found: dict[str, Node]) -> None:
        for entry in self.reader.entries(found.get("let"), "`let`"):
            if entry.key.text in self.names.places:
                self.reader.report(
                    "E102", f"`{entry.key.text}` is already the name of something", entry.key.span
                )
            else:
                self.lets[entry.key.text] = entry.value
        also = {entry.key.text: entry for entry in self.reader.entries(found.get("also"), "`also`")}
        for entry in self.reader.entries(found.get("draw"), "`draw`"):
            self._draw(also.pop(entry.key.text, entry), "`draw`")
        for entry in also.values():
            self._draw(entry, "`also`")
        for name in list(self.lets):
            self._let(name)

    def _draw(self, entry: Entry, where: str) -> None:
        """One state."""
        columns = states_of(entry, where, self.reader, self.names)
        if not columns:
            return
        self._needed(entry.value)
        here = self.drawn.expressions(self.names, self.reader)
        self.found.extend(shared_draws(state_assigns(entry, where, here, self.names)))
        self.drawn = replace(self.drawn, states=self.drawn.states | {column.name for column in columns})

    def _needed(self, node: Node) -> None:
        """The local names that an expression mentions."""
        texts = [written(item) for item in (node.items if isinstance(node, Sequence) else (node,))]
        for name in list(self.lets):
            if any(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text) for text in texts):
                self._let(name)

    def _let(self, name: str) -> None:
        """One local name, and those that it needs."""
        if name not in self.lets:
            return
        node = self.lets.pop(name)
        self._needed(node)
        numbers = self.drawn.expressions(self.names, self.reader).numbers(node, f"`{name}`")
        known: Number | Vector = Number(ir.Const(0.0), flexible=True)
        if numbers is not None:
            vector = len(numbers) > 1 or isinstance(node, Sequence)
            called = component_names(name, len(numbers) if vector else None)
            assigns = [
                Assign(each, number.num, written(node)) for each, number in zip(called, numbers, strict=True)
            ]
            self.found.extend(shared_draws(assigns))
            items = tuple(
                replace(number, num=ir.Signal(each), exact=None, span=None, origin=None)
                for each, number in zip(called, numbers, strict=True)
            )
            known = Vector(items) if vector else items[0]
        self.drawn = replace(self.drawn, locals=(*self.drawn.locals, (name, known)))
