"""Perturbable declarations: a factor for every uncertain number of the dynamics.

`stlc.dynamics.declaration.uncertain` says which numbers these are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

from stlc.compile.frontend.scope import Entry, Known
from stlc.compile.frontend.values import Number
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.declaration.schema.names import Names, NumberChanges, base_name, each_number
from stlc.dynamics.declaration.schema.yaml_nodes import Mapping as MappingNode
from stlc.dynamics.declaration.schema.yaml_nodes import Sequence
from stlc.dynamics.declaration.sections import Motion, SystemKeys, motion_of, sections_of
from stlc.dynamics.declaration.uncertain import NumbersInUse, UncertainNumbers, uncertain_numbers


@dataclass(frozen=True, slots=True)
class Uncertain:
    """An uncertain number of the dynamics.

    Attributes:
        factor: name of the column by which the number is multiplied; it is 1 in the model.
        text: source text of the number, such as `vy` or `0.01 m/rad`.
        states: names of the states whose equations, resets or samples read the number.
    """

    factor: str
    text: str
    states: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.text} (of {', '.join(self.states)})"


@dataclass(frozen=True, slots=True)
class Perturbable:
    """Declaration of a system in which every uncertain number of the dynamics is multiplied by a factor.

    Attributes:
        decl: the declaration; the factors are columns that the dynamics read.
        numbers: the uncertain numbers.
        started: values at the start of the columns that are computed at samples, in order, if one of them
            reads a factor.
        exact: names of constants that the dynamics read and that count as exact.
    """

    decl: SystemDecl
    numbers: tuple[Uncertain, ...]
    started: tuple[Assign, ...] = ()
    exact: tuple[str, ...] = ()


def perturbable(decl: SystemDecl) -> Perturbable:
    """Multiply each uncertain number of a declaration's dynamics by a factor; return the result.

    Raises:
        SystemFileError: S212, an error of a number cannot be carried to a place where it stands; S213, a
            constant that the file lists as uncertain changes nothing.
    """
    found = sections_of(decl)
    choice = uncertain_numbers(decl, found)
    texts = {**{_factor(name): name for name in choice.constants}, **choice.literals}
    listed = decl.test.uncertain is not None
    motion = _factored_motion(decl, found, choice, texts)
    factored = _with_motion(decl, motion, every=listed)
    started, readers = factored.init.computed, _readers(factored)
    numbers = tuple(Uncertain(factor, text, tuple(readers[factor])) for factor, text in texts.items())
    if listed:
        for number in numbers:
            worth = [value for name, (value, _) in decl.constants.items() if base_name(name) == number.text]
            if not number.states or not any(worth):
                raise _without_effect(number, found, decl)
    late = any(texts.keys() & each.value.columns for each in started)
    return Perturbable(
        replace(factored, init=decl.init),
        tuple(each for each in numbers if each.states),
        started if late else (),
        choice.exact,
    )


def _factored_motion(
    decl: SystemDecl, found: SystemKeys, choice: UncertainNumbers, texts: dict[str, str]
) -> Motion:
    """Read the motion of a system again, with a factor at every uncertain number."""

    def scaled(name: str, entry: Known) -> Entry:
        if name not in choice.constants:
            return entry
        return each_number(entry, partial(_scaled, factor=ir.Signal(_factor(name))))

    factors: dict[str, Entry] = {
        factor: Known(Number(ir.Signal(factor), flexible=True, bare=True)) for factor in texts
    }
    names = Names()
    used = NumbersInUse(names, frozenset(map(base_name, decl.constants)))
    rewrite = used.rewritten if decl.test.uncertain is None else None
    names.changes = NumberChanges(scaled, rewrite, factors)
    return motion_of(found, decl, names)


def _with_motion(decl: SystemDecl, motion: Motion, *, every: bool) -> SystemDecl:
    """Return the declaration with another motion; unless `every`, only that of real columns is taken."""
    taken = {column.name for column in decl.signature.columns if every or column.kind == "real"}

    def replaced(assigns: tuple[Assign, ...], others: tuple[Assign, ...]) -> tuple[Assign, ...]:
        values = {assign.name: assign for assign in others if assign.name in taken}
        return tuple(values.get(assign.name, assign) for assign in assigns)

    jumps = tuple(
        replace(jump, guard=other.guard, resets=replaced(jump.resets, other.resets))
        for jump, other in zip(decl.jumps, motion.jumps, strict=True)
    )
    return replace(
        decl,
        flow=replaced(decl.flow, (*motion.flow, *motion.sampled.flow)),
        jumps=jumps,
        updates=replaced(decl.updates, motion.updates),
        init=replace(decl.init, computed=replaced(decl.init.computed, motion.initial)),
    )


def _readers(decl: SystemDecl) -> Mapping[str, dict[str, None]]:
    """Return the names of the states whose next value, or value at the start, depends on a column.

    Either an assignment of such a state reads the column, or a jump that sets the state reads it, in its
    guard or its reset.
    """
    found: defaultdict[str, dict[str, None]] = defaultdict(dict)
    read = [(each.name, each.value.columns) for each in (*decl.flow, *decl.updates, *decl.init.computed)]
    for jump in decl.jumps:
        guard = jump.guard.columns
        read += [(each.name, guard | each.value.columns) for each in jump.resets]
    for name, columns in read:
        for column in columns:
            found[column][base_name(name)] = None
    return found


def _without_effect(number: Uncertain, found: SystemKeys, decl: SystemDecl) -> SystemFileError:
    """Return the error S213 about a listed constant that changes nothing."""
    why = f"nothing that moves reads `{number.text}`"
    node = found.test.get("uncertain") if isinstance(found.test, MappingNode) else None
    items = node.items if isinstance(node, Sequence) else ()
    span = next((item.span for item in items if getattr(item, "text", "") == number.text), None)
    if number.states:
        why = f"`{number.text}` is 0, of which a relative error changes nothing"
    elif any(unit.offset for name, (_, unit) in decl.constants.items() if base_name(name) == number.text):
        why = f"`{number.text}` is a temperature on a scale, which has no relative error"
    message = f"an uncertain constant without effect: {why}"
    advice = "leave it out of `uncertain`, or list the constants that the dynamics read"
    return SystemFileError.of("S213", message, span, "listed here", help=(advice,))


def _factor(name: str) -> str:
    return f"?{name}"


def _scaled(number: Number, factor: ir.Num) -> Number:
    """Multiply a number by a factor; one on a scale such as degC has no relative error and stays as it is."""
    if number.unit.offset:
        return number
    return replace(number, num=number.num * factor, exact=None)
