"""Instants at which a formula has a value on a recording without cutting anything."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, TypeAlias

import numpy as np
from proof.language import (
    Atom,
    Choice,
    Edge,
    Formula,
    Frozen,
    Many,
    Meet,
    Not,
    Over,
    Pair,
    Row,
    Step,
    Use,
    nodes,
)
from proof.levels import FUTURE, Instants, inside, unfolded

Rows: TypeAlias = Sequence[Row]
Names: TypeAlias = frozenset[str]


def defined(formula: Formula, rows: Rows, positive: bool = True, held: Names = frozenset()) -> Instants:
    """Instants at which nothing that is read leaves the trace; `held`: names that are frozen around."""
    everywhere = (1 << len(rows)) - 1
    match formula:
        case Atom(_, margin):
            return _there(margin, rows, held)
        case Frozen(bindings, body):
            read = read_in(body)
            inner = held | {name for name, _, _ in bindings}
            bound = [_there(value, rows, held) for name, _, value in bindings if name in read]
            return reduce(int.__and__, bound, defined(body, rows, positive, inner))
        case Over() | Meet():
            return _window_defined(formula, rows, positive, held)
        case Not(body):
            return defined(body, rows, not positive, held)
        case Step(steps, body):
            inner = defined(body, rows, positive, held)
            return inner >> 1 if steps > 0 else (inner << 1) & everywhere
        case Edge(op, body):
            now = defined(body, rows, (op == "rise") is positive, held)
            before = defined(body, rows, (op == "rise") is not positive, held)
            return now & ((before << 1) | 1)
        case Pair("->", left, right):
            return defined(left, rows, not positive, held) & defined(right, rows, positive, held)
        case Pair(_, left, right):
            both = [defined(side, rows, sign, held) for side in (left, right) for sign in (True, False)]
            return reduce(int.__and__, both)
        case Choice(cond, yes, no):
            sides = [defined(part, rows, positive, held) for part in (yes, no)]
            return reduce(
                int.__and__, sides, defined(cond, rows, True, held) & defined(cond, rows, False, held)
            )
        case Many(_, items):
            return reduce(int.__and__, [defined(item, rows, positive, held) for item in items])
        case Use():
            return defined(formula.meaning, rows, positive, held)
        case _:
            return everywhere


def _window_defined(formula: Over | Meet, rows: Rows, positive: bool, held: Names) -> Instants:
    """Every instant that the window reads, and those on the way there, exist and are defined."""
    window, forward, samples = formula.window, formula.op in FUTURE, len(rows)
    if isinstance(formula, Meet) and formula.op == "unless":
        whole, met = unfolded(formula)
        return _window_defined(whole, rows, positive, held) & _window_defined(met, rows, positive, held)
    every = (formula.op in ("always", "historically", "release")) is positive
    last = samples + 64 if window.hi is None else math.ceil(window.hi) + 1
    distances = [k for k in range(last + 1) if inside(window, k, outward=every)]
    target = defined(formula.right if isinstance(formula, Meet) else formula.body, rows, positive, held)
    way = defined(formula.left, rows, positive, held) if isinstance(formula, Meet) else (1 << samples) - 1
    found = 0
    for t in range(samples):
        reads = [t + k if forward else t - k for k in distances]
        if not forward:
            reads = [k for k in reads if k >= 0]
        elif window.hi is None:
            reads = [k for k in reads if k < samples]
            if not reads:
                continue
        passed = range(min([t, *reads]), max([t, *reads]) + 1) if reads else ()
        if all(k < samples and target >> k & 1 for k in reads) and all(way >> k & 1 for k in passed):
            found |= 1 << t
    if window.absolute:
        return (1 << samples) - 1 if found & 1 else 0
    return found


def _there(value: Callable[[Row], Any], rows: Rows, held: Names) -> Instants:
    """The samples at which everything exists that a number reads."""
    read = names_of(value) - held
    return sum(1 << t for t, row in enumerate(rows) if read <= row.keys())


def read_in(formula: Formula) -> Names:
    """Reads of the predicates of a formula, and of the numbers that it freezes."""
    found: Names = frozenset()
    for node in nodes(formula):
        match node:
            case Atom(_, margin):
                found |= names_of(margin)
            case Frozen(bindings):
                found = found.union(*(names_of(value) for _, _, value in bindings))
    return found


def names_of(value: Callable[[Row], Any]) -> Names:
    """Names that a number reads, found by giving it one after the other."""
    row: dict[str, Any] = {}
    while True:
        try:
            value(row)
        except KeyError as missing:
            row[missing.args[0]] = np.zeros(3) if missing.args[0] == "q" else 0.5
        else:
            return frozenset(row)
