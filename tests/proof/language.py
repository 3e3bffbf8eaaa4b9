"""Formulas as the manual defines them, and how people write them: no part of stlc is used here.

A formula is drawn (`proof.draw`), written as text (`proof.written`) and judged by the definitions
(`proof.levels`). Time is in steps. Nodes compare by identity: each stands at one place of one formula.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal, TypeAlias

Row: TypeAlias = Mapping[str, Any]
"""The signals at one sample."""


@dataclass(frozen=True, eq=False)
class Atom:
    """A predicate as text, with its margin; `strict`: false where the margin is 0."""

    text: str
    margin: Callable[[Row], float]
    strict: bool


@dataclass(frozen=True, eq=False)
class Constant:
    """`true` or `false`."""

    value: bool


@dataclass(frozen=True, eq=False)
class Not:
    """Negation."""

    body: Formula


@dataclass(frozen=True, eq=False)
class Many:
    """`and`, `or`, `forall` or `exists` over some formulas; a quantifier brings its text along."""

    op: Literal["and", "or"]
    items: tuple[Formula, ...]
    text: str = ""


@dataclass(frozen=True, eq=False)
class Pair:
    """`->`, `<->` or `xor`."""

    op: Literal["->", "<->", "xor"]
    left: Formula
    right: Formula


@dataclass(frozen=True, eq=False)
class Choice:
    """`if cond then yes else no`: `(cond and yes) or (not cond and no)`."""

    cond: Formula
    yes: Formula
    no: Formula


@dataclass(frozen=True)
class Window:
    """Bounds in steps, not always whole; `hi` None: to the end. `text`: as written, "" for none."""

    lo: Fraction
    hi: Fraction | None
    lo_open: bool
    hi_open: bool
    text: str
    absolute: bool = False


@dataclass(frozen=True, eq=False)
class Over:
    """A temporal operator with one operand."""

    op: Literal["always", "eventually", "historically", "once"]
    window: Window
    body: Formula


@dataclass(frozen=True, eq=False)
class Meet:
    """A temporal operator with two operands."""

    op: Literal["until", "release", "unless", "since"]
    window: Window
    left: Formula
    right: Formula


@dataclass(frozen=True, eq=False)
class Step:
    """`next` (1) or `prev` (-1)."""

    steps: Literal[1, -1]
    body: Formula


@dataclass(frozen=True, eq=False)
class Edge:
    """`rise` or `fall`."""

    op: Literal["rise", "fall"]
    body: Formula


@dataclass(frozen=True, eq=False)
class Use:
    """A `def` in use: what it means, and its declaration. With arguments it is a call."""

    name: str
    formals: tuple[str, ...]
    arguments: tuple[Formula, ...]
    template: Formula
    meaning: Formula


@dataclass(frozen=True, eq=False)
class Formal:
    """An argument inside of a `def`."""

    name: str


@dataclass(frozen=True, eq=False)
class Frozen:
    """`freeze name = …, … in body`: text and value of each number that is kept; its name becomes a signal."""

    bindings: tuple[tuple[str, str, Callable[[Row], float]], ...]
    body: Formula


Formula: TypeAlias = (
    Atom | Constant | Not | Many | Pair | Choice | Over | Meet | Step | Edge | Use | Formal | Frozen
)


def parts(formula: Formula) -> tuple[Formula, ...]:
    """The operands."""
    match formula:
        case Atom() | Constant() | Formal():
            return ()
        case Not() | Over() | Step() | Edge() | Frozen():
            return (formula.body,)
        case Many():
            return formula.items
        case Pair() | Meet():
            return (formula.left, formula.right)
        case Choice():
            return (formula.cond, formula.yes, formula.no)
        case Use():
            return (formula.meaning,)
    raise TypeError(formula)


def nodes(formula: Formula) -> Iterator[Formula]:
    """All of them, the formula first."""
    yield formula
    for part in parts(formula):
        yield from nodes(part)


def windows(formula: Formula) -> list[Window]:
    """The windows of all temporal operators."""
    return [node.window for node in nodes(formula) if isinstance(node, Over | Meet)]


def substituted(template: Formula, bound: Mapping[str, Formula]) -> Formula:
    """The template with its formals replaced; only the nodes that templates are made of."""
    match template:
        case Formal(name):
            return bound[name]
        case Over(op, window, body):
            return Over(op, window, substituted(body, bound))
        case Pair(op, left, right):
            return Pair(op, substituted(left, bound), substituted(right, bound))
        case Many(op, items):
            return Many(op, tuple(substituted(item, bound) for item in items))
        case Not(body):
            return Not(substituted(body, bound))
        case _:
            return template
