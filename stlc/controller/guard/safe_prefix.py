"""Robustness of every prefix of a plan, whatever comes after it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import map_children

BEYOND = "#beyond"


def open_ended(formula: ir.Formula) -> ir.Formula:
    """The formula with every predicate true where the column `BEYOND` is positive.

    In negation normal form robustness grows with that of each predicate, so this is the upper bound over all
    ways in which the trace may go on: negative exactly where the known samples already violate the formula.
    """
    if isinstance(formula, ir.Predicate):
        return ir.BoolOp("or", (formula, ir.Predicate(ir.Signal(BEYOND), strict=True, guard=True)))
    return map_children(formula, formulas=open_ended)


def anchored(formula: ir.Formula) -> ir.Formula:
    """The formula with what is said of the start alone turned into guards: it decides, but limits no margin.

    All plans share their start. Where plans that violate it are compared, `a -> always b` should tell how far
    b is violated, not how clearly a holds.
    """
    match formula:
        case ir.Predicate():
            return replace(formula, guard=True)
        case ir.BoolOp():
            return replace(formula, items=tuple(map(anchored, formula.items)))
        case _:
            return formula


def robustness_until(
    formulas: Sequence[ir.Formula], columns: Mapping[str, Tensor], last: int | Tensor
) -> Tensor:
    """The least robustness of formulas on the samples 0 to `last`, whatever comes after them: (batch,).

    `columns`: name -> (time, batch), as long as the formulas look. `last`: one number, or (batch,).
    """
    like = next(iter(columns.values()))
    index = torch.arange(len(like), device=like.device)[:, None].expand(like.shape)
    env = {**columns, BEYOND: torch.where(index > last, 1.0, -1.0).to(like.dtype)}
    margins = evaluate([open_ended(formula) for formula in formulas], env, ops=TORCH)
    return torch.stack([margin[0].expand(like.shape[1]) for margin in margins]).amin(0)


def prefix_robustness(formulas: Sequence[ir.Formula], columns: Mapping[str, Tensor]) -> Tensor:
    """The least robustness of the anchored formulas on every prefix, whatever comes after it; exact.

    Args:
        formulas: the safety requirements.
        columns: name -> (time, batch).

    Returns:
        (time, batch), never rising over time: entry k is that of the samples 0 to k.
    """
    like = next(iter(columns.values()))
    steps, batch = like.shape
    if not formulas:
        return torch.full_like(like, torch.inf)
    index = torch.arange(steps, device=like.device)
    beyond = torch.where(index[:, None] > index[None], 1.0, -1.0).to(like.dtype)
    env = {name: column.repeat(1, steps) for name, column in columns.items()}
    env[BEYOND] = beyond.repeat_interleave(batch, 1)
    opened = [open_ended(anchored(formula)) for formula in formulas]
    margins = evaluate(opened, env, ops=TORCH)
    return torch.stack([margin[0].expand(steps * batch) for margin in margins]).amin(0).view(steps, batch)
