"""The formulas whose robustness is timed, each with how one would write it in plain torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from torch import Tensor

from stlc.bench import plain
from stlc.compile.ir import nodes as ir

Plain: TypeAlias = Callable[[Tensor, Tensor, int], Tensor]
"""Signals x and y `(time, batch)` and the width of a window in steps -> robustness at every sample."""

_TEN = tuple(0.1 * number for number in range(10))


@dataclass(frozen=True, slots=True)
class Case:
    """A formula over the signals `x` and `y`.

    Attributes:
        name: as it is printed; `w` stands for the width of its windows.
        formula: for windows of so many steps.
        plain: the same in plain torch.
    """

    name: str
    formula: Callable[[int], ir.Formula]
    plain: Plain


def _atom(name: str, above: float = 0.0) -> ir.Predicate:
    column = ir.Signal(name)
    return ir.Predicate(ir.Op("sub", (column, ir.Const(above))) if above else column)


def _over(op: str, hi: int | None, body: ir.Formula) -> ir.Temporal:
    return ir.Temporal("always" if op == "always" else "eventually", ir.Window(0, hi), body)


CASES = (
    Case(
        "G[0,end] p",
        lambda _: _over("always", None, _atom("x")),
        lambda x, _, __: plain.always_to_end(x),
    ),
    Case(
        "G[0,w] p",
        lambda width: _over("always", width, _atom("x")),
        lambda x, _, width: plain.always(x, width),
    ),
    Case(
        "F[0,w] p",
        lambda width: _over("eventually", width, _atom("x")),
        lambda x, _, width: plain.eventually(x, width),
    ),
    Case(
        "G[0,end] F[0,w] p",
        lambda width: _over("always", None, _over("eventually", width, _atom("x"))),
        lambda x, _, width: plain.always_to_end(plain.eventually(x, width)),
    ),
    Case(
        "p U[0,w] q",
        lambda width: ir.Until("until", ir.Window(0, width), _atom("x"), _atom("y")),
        plain.until,
    ),
    Case(
        "p1 and ... and p10",
        lambda _: ir.BoolOp("and", tuple(_atom("x", above) for above in _TEN)),
        lambda x, _, __: plain.conjunction(x, _TEN),
    ),
)
"""What there is to time."""
