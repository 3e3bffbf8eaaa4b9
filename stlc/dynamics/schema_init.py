"""Initial states: situations, branches, local names, conditions."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from stlc.compile import ir
from stlc.compile.scope import Entry as Name
from stlc.compile.scope import Known
from stlc.compile.values import Number
from stlc.dynamics.decl import Assign, InitDecl, Situation
from stlc.dynamics.schema_expressions import Expressions, in_stored_unit, written
from stlc.dynamics.schema_flow import column_assign, state_of
from stlc.dynamics.schema_names import Names, later
from stlc.dynamics.schema_reader import Reader, first_line
from stlc.dynamics.yaml_nodes import Entry, Mapping, Node

INIT_KEYS = ("mixture", "where", "grid", "from")
SITUATION_KEYS = ("name", "weight", "draw", "choose", "let", "also")


@dataclass(frozen=True, slots=True)
class _Drawn:
    """What has a value at some point of a situation: states, and local names with their numbers."""

    states: frozenset[str] = frozenset()
    locals: tuple[tuple[str, Number], ...] = ()

    def expressions(self, names: Names, reader: Reader) -> Expressions:
        """Expressions that may draw, and read what has a value."""
        entries: dict[str, Name] = {name: Known(number, "local name") for name, number in self.locals}
        ready = self.states | {name for name, _ in self.locals}
        return names.expressions(reader).extended(entries, samplers=True, ready=ready)


def read_init(node: Node | None, reader: Reader, names: Names) -> InitDecl:
    """The section `init`."""
    if node is None:
        reader.report(
            "S102", "the file lacks `init`", reader.source.span(0, 1), "init: {mixture: [{draw: {x: 0}}]}"
        )
        return InitDecl(())
    found = reader.fields(node, "`init`", INIT_KEYS)
    for key in ("grid", "from"):
        if key in found:
            later(reader, found[key], f"`{key}` under `init`")
    items = reader.items(found.get("mixture"), "`mixture`")
    if not items and not {"grid", "from"} & found.keys():
        reader.report(
            "S102",
            "`init` lacks a `mixture` of situations",
            first_line(node.span),
            "mixture: [{draw: {x: 0}}]",
        )
    mixture = _mixture(items, _Drawn(), reader, names)
    where, texts = _conditions(found.get("where"), names.expressions(reader))
    span = found["where"].span if "where" in found else node.span
    return InitDecl(mixture, where, texts, first_line(span))


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
    name = reader.text(found.get("name"), "`name` of a situation") or ""
    weight = reader.number(found.get("weight"), "`weight`")
    draws = _Draws(reader, names, drawn)
    draws.read(found)
    choices = reader.items(found.get("choose"), "`choose`")
    branches = _mixture(choices, draws.drawn, reader, names)
    missing = [column.name for column in names.columns if column.name not in draws.drawn.states]
    if missing and not choices and not draws.failed and isinstance(node, Mapping):
        listed = ", ".join(f"`{column}`" for column in missing)
        called = f"the situation `{name}`" if name else "this situation"
        reader.report(
            "S102",
            f"{called} draws no value for {listed}",
            first_line(node.span),
            "every state needs a first value",
        )
    return Situation(name, 1.0 if weight is None else weight, tuple(draws.found), branches)


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
        column = state_of(entry, where, self.reader, self.names)
        if column is None:
            return
        self._needed(entry.value)
        assign = column_assign(column, entry.value, self.drawn.expressions(self.names, self.reader))
        if assign is not None:
            self.found.append(assign)
        self.drawn = replace(self.drawn, states=self.drawn.states | {column.name})

    def _needed(self, node: Node) -> None:
        """The local names that an expression mentions."""
        text = written(node)
        for name in list(self.lets):
            if re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text):
                self._let(name)

    def _let(self, name: str) -> None:
        """One local name, and those that it needs."""
        if name not in self.lets:
            return
        node = self.lets.pop(name)
        self._needed(node)
        number = self.drawn.expressions(self.names, self.reader).number(node, f"`{name}`")
        if number is None:
            number = Number(ir.Lit(0.0), flexible=True)
        else:
            self.found.append(Assign(name, in_stored_unit(number, number.unit.si), written(node)))
        known = replace(number, num=ir.Col(name), exact=None, span=None, origin=None)
        self.drawn = replace(self.drawn, locals=(*self.drawn.locals, (name, known)))
