"""How far a formula looks: into the past, into the future, to the end of the trace; and at which columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, assert_never

from stlc.compile import ir


class Reach(NamedTuple):
    """Steps that a formula may look back and ahead from where it is judged."""

    past: int
    future: int


def reach(formula: ir.Formula) -> Reach:
    """How many steps `formula` needs before and after the instant where it is judged.

    A window to the end of the trace counts with its start alone: it takes what there is from there on.
    Windows of the past are cut at the start of the trace: the past is what they use, never what they need.
    """
    match formula:
        case ir.Truth() | ir.Atom():
            return Reach(0, 0)
        case ir.Join(_, items):
            return _furthest(*map(reach, items))
        case ir.Over(_, window, body):
            return _ahead(reach(body), window)
        case ir.Past(_, window, body):
            return _back(reach(body), window)
        case ir.Until(_, window, left, right):
            return _furthest(_ahead(reach(right), window), _ahead(reach(left), ir.Window(0, window.hi)))
        case ir.Since(_, window, left, right):
            return _furthest(_back(reach(right), window), _back(reach(left), ir.Window(0, window.hi)))
        case ir.Shift(steps, body):
            inner = reach(body)
            return Reach(max(inner.past - steps, 0), max(inner.future + steps, 0))
        case _:
            assert_never(formula)


def _furthest(*parts: Reach) -> Reach:
    return Reach(max(part.past for part in parts), max(part.future for part in parts))


def _ahead(body: Reach, window: ir.Window) -> Reach:
    last = window.lo if window.hi is None else window.hi
    return Reach(max(body.past - window.lo, 0), body.future + last)


def _back(body: Reach, window: ir.Window) -> Reach:
    last = window.lo if window.hi is None else window.hi
    return Reach(body.past + last, max(body.future - window.lo, 0))


def uses_end(formula: ir.Formula) -> bool:
    """Whether a window of the future runs to the end of the trace."""
    return any(isinstance(n, (ir.Over, ir.Until)) and n.window.hi is None for n in nodes(formula))


def nodes(formula: ir.Formula) -> Iterator[ir.Formula]:
    """All formulas in `formula`, itself first; conditions inside of numbers are not among them."""
    yield formula
    for part in parts(formula):
        yield from nodes(part)


def parts(formula: ir.Formula) -> tuple[ir.Formula, ...]:
    """The operands of a formula."""
    match formula:
        case ir.Truth() | ir.Atom():
            return ()
        case ir.Join(_, items):
            return items
        case ir.Over(_, _, body) | ir.Past(_, _, body) | ir.Shift(_, body):
            return (body,)
        case ir.Until(_, _, left, right) | ir.Since(_, _, left, right):
            return (left, right)
        case _:
            assert_never(formula)


def columns(formula: ir.Formula) -> frozenset[str]:
    """Names of the columns that a formula reads."""
    atoms = (node for node in nodes(formula) if isinstance(node, ir.Atom))
    return frozenset(name for atom in atoms for name in _read(atom.num))


def _read(num: ir.Num) -> frozenset[str]:
    match num:
        case ir.Lit():
            return frozenset()
        case ir.Col(name):
            return frozenset({name})
        case ir.Op(_, args) | ir.Extern(_, args):
            return frozenset().union(*map(_read, args))
        case ir.Ind(cond):
            return columns(cond)
        case ir.Where(cond, yes, no):
            return columns(cond) | _read(yes) | _read(no)
        case _:
            assert_never(num)
