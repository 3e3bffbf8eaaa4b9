"""How far a plan that is not safe can be followed, and by how much it fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import assert_never

import torch
from torch import Tensor

from stlc.compile import ir
from stlc.compile.graph import evaluate
from stlc.compile.ops_torch import TORCH
from stlc.compile.semantics import TOLERANCE

BEYOND = "#beyond"


def open_ended(formula: ir.Formula) -> ir.Formula:
    """The formula with every predicate true where the column `BEYOND` is positive.

    In negation normal form robustness grows with that of each predicate, so this is the upper bound over all
    ways in which the trace may go on: negative exactly where the known samples already violate the formula.
    """
    match formula:
        case ir.Truth():
            return formula
        case ir.Atom():
            return ir.Join("or", (formula, ir.Atom(ir.Col(BEYOND), strict=True, guard=True)))
        case ir.Join():
            return replace(formula, items=tuple(map(open_ended, formula.items)))
        case ir.Over() | ir.Past() | ir.Shift():
            return replace(formula, body=open_ended(formula.body))
        case ir.Until() | ir.Since():
            return replace(formula, left=open_ended(formula.left), right=open_ended(formula.right))
        case _:
            assert_never(formula)


def anchored(formula: ir.Formula) -> ir.Formula:
    """The formula with what is said of the start alone turned into guards: it decides, but limits no margin.

    All plans share their start. Where plans that violate the formula are compared, `a -> always b` should tell
    how far b is violated, not how clearly a holds.
    """
    match formula:
        case ir.Atom():
            return replace(formula, guard=True)
        case ir.Join():
            return replace(formula, items=tuple(map(anchored, formula.items)))
        case _:
            return formula


def safety_margin(formulas: Sequence[ir.Formula], columns: Mapping[str, Tensor]) -> Tensor:
    """Least robustness of the anchored formulas, (batch,); +inf where there is none."""
    batch = next(iter(columns.values()))[0]
    if not formulas:
        return torch.full_like(batch, torch.inf)
    margins = evaluate([anchored(formula) for formula in formulas], columns, ops=TORCH)
    return torch.stack([margin[0].expand_as(batch) for margin in margins]).amin(0)


def safe_samples(formulas: Sequence[ir.Formula], columns: Mapping[str, Tensor]) -> Tensor:
    """How many samples from the start on keep all formulas, by bisection; exact.

    Args:
        formulas: the safety requirements.
        columns: name -> (time, batch).

    Returns:
        (batch,) int64, 0 to time.
    """
    steps, batch = next(iter(columns.values())).shape
    device = next(iter(columns.values())).device
    opened = [open_ended(formula) for formula in formulas]
    index = torch.arange(steps, device=device)[:, None]
    low = torch.zeros(batch, dtype=torch.int64, device=device)
    high = torch.full_like(low, steps if opened else 0)
    while bool((low < high).any()):
        middle = (low + high + 1) // 2
        beyond = torch.where(index >= middle, 1.0, -1.0).to(torch.float64)
        margins = evaluate(opened, {**columns, BEYOND: beyond}, ops=TORCH)
        kept = torch.stack([margin[0] for margin in margins]).amin(0) >= -TOLERANCE
        low, high = torch.where(kept, middle, low), torch.where(kept, high, middle - 1)
    return low if opened else torch.full_like(low, steps)
