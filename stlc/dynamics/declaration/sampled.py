"""Columns that are computed at every sample from the other columns, and the clock that counts samples.

Input signals, held values and delays are such columns. They are computed after the flow and the jumps of a
step, and are constant until the next sample.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.declaration.schema.names import Context
from stlc.signature import Column
from stlc.source import Span
from stlc.units import Unit

CLOCK = "step_count"
"""Name of the column that counts the samples since the start."""


@dataclass(frozen=True, slots=True)
class Sampled:
    """Columns that are computed at every sample.

    Attributes:
        drawn: distributions of numbers that are drawn once per trajectory, before the states.
        initial: values at the start, computed after the states are drawn.
        updates: values at every later sample, computed after flow and jumps. A name stands for the value at
            the sample itself; with the suffix `ir.BEFORE`, for the value at the sample before.
        flow: derivatives of these columns within a step.
        hidden: columns that policies do not observe unless `policy: {observe: …}` lists them.
    """

    drawn: tuple[Assign, ...] = ()
    initial: tuple[Assign, ...] = ()
    updates: tuple[Assign, ...] = ()
    flow: tuple[Assign, ...] = ()
    hidden: tuple[str, ...] = ()

    def __add__(self, other: Sampled) -> Sampled:
        """Return the columns of both."""
        return Sampled(
            self.drawn + other.drawn,
            self.initial + other.initial,
            self.updates + other.updates,
            self.flow + other.flow,
            self.hidden + other.hidden,
        )


def declared(cx: Context, column: Column, span: Span) -> None:
    """Append a column that follows from another declaration, located at `span`.

    E102 is reported if a declaration of the file has its name.
    """
    names = cx.names
    if column.name in names.places:
        cx.reader.report("E102", f"`{column.name}` is declared, and is also needed here", span, "rename it")
    names.columns.append(column)
    names.places.setdefault(column.name, span)


def clock(cx: Context, span: Span, *, flows: bool) -> Sampled:
    """Declare the column that counts samples, unless it is there already.

    `span` is the location of a declaration that needs it. If `flows`, the clock also runs within a step, as
    an interpolated input signal needs it.
    """
    column = Column(CLOCK, Unit(), role="timer")
    if column in cx.names.columns:
        return Sampled()
    declared(cx, column, span)
    start, later = Assign(CLOCK, ir.Const(0.0), "0"), ir.Signal(CLOCK + ir.BEFORE) + 1.0
    rate = (Assign(CLOCK, ir.Const(float(1 / cx.dt)), "1 / dt"),) if flows and not cx.discrete else ()
    return Sampled((start,), (), (Assign(CLOCK, later, "samples"),), rate, (CLOCK,))


def in_order(assigns: Iterable[Assign], cx: Context) -> tuple[Assign, ...]:
    """Return assignments such that each follows those whose values it reads.

    S202 is reported if values depend on each other at the same sample.
    """
    known = {assign.name: assign for assign in assigns}
    reads = {name: assign.value.columns & known.keys() for name, assign in known.items()}
    try:
        return tuple(known[name] for name in TopologicalSorter(reads).static_order())
    except CycleError as error:
        cycle: list[str] = error.args[1]
        listed = ", ".join(f"`{name}`" for name in dict.fromkeys(cycle))
        place = next(cx.names.places[name] for name in cycle if name in cx.names.places)
        message = f"the values of {listed} depend on each other at the same sample"
        cx.reader.report("S202", message, place, "read the value before, as `prev(…)`")
        return tuple(known.values())
