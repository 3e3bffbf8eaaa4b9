"""Upper bounds on the robustness of plan prefixes over all continuations."""

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
    continuations of the trace: negative exactly where the known samples already violate the formula.
    """
    if isinstance(formula, ir.Predicate):
        return ir.BoolOp("or", (formula, ir.Predicate(ir.Signal(BEYOND), strict=True, guard=True)))
    return map_children(formula, formulas=open_ended)


def anchored(formula: ir.Formula) -> ir.Formula:
    """The formula with predicates on the initial state as conditions that do not limit the margin.

    All plans share the initial state, so plans that violate `a -> always b` are compared by the violation of
    b, not by the robustness of a.
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
    """Minimum over formulas of the robustness upper bound given the samples 0 to `last`: (batch,).

    `columns`: name -> (time, batch), as long as the formulas' horizon. `last`: one number, or (batch,).
    """
    like = next(iter(columns.values()))
    index = torch.arange(len(like), device=like.device)[:, None].expand(like.shape)
    env = {**columns, BEYOND: torch.where(index > last, 1.0, -1.0).to(like.dtype)}
    margins = evaluate([open_ended(formula) for formula in formulas], env, ops=TORCH)
    return torch.stack([margin[0].expand(like.shape[1]) for margin in margins]).amin(0)


def prefix_robustness(formulas: Sequence[ir.Formula], columns: Mapping[str, Tensor]) -> Tensor:
    """Minimum over the anchored formulas of the exact robustness upper bound given each prefix.

    Args:
        formulas: the safety requirements.
        columns: name -> (time, batch).

    Returns:
        (time, batch), non-increasing over time: entry k is that of the samples 0 to k.
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
