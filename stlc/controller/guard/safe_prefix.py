"""Upper bounds on the robustness of plans of which only the first steps (a prefix) are known.

The bound holds for every continuation. If it is negative, each plan with this prefix violates the formula.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.schedule import PICKS
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir

BEYOND = "#beyond"


def open_ended(formula: ir.Formula) -> ir.Formula:
    """Return a formula for the best robustness that `formula` can reach, given only its first samples.

    The robustness of the returned formula is an upper bound on that of `formula`, for all values of the later
    samples. At these samples, every predicate counts as true. The signals must contain a column named
    `BEYOND`, which is negative at the known samples and positive at the later ones. `formula` must be in
    negation normal form, so that its robustness never decreases when a predicate becomes true. The bound is
    negative exactly if the known samples already violate `formula`.
    """
    if isinstance(formula, ir.Predicate):
        return formula | ir.Predicate(ir.Signal(BEYOND), strict=True, guard=True)
    return formula.map_children(formulas=open_ended)


def anchored(formula: ir.Formula) -> ir.Formula:
    """Return a formula in which predicates on the initial state count as true or false, without a degree.

    Example: in `a -> always b`, let `a` depend on the initial state alone. Then `a` is the same for all
    plans. Plans that violate the formula are therefore compared by the robustness of `b`, not by that of `a`.
    """
    return formula.map_terms(
        lambda part: replace(part, guard=True) if isinstance(part, ir.Predicate) else part
    )


def robustness_until(
    formulas: Sequence[ir.Formula], columns: Mapping[str, Tensor], last: int | Tensor
) -> Tensor:
    """Upper bound on the least robustness of `formulas`, if only the samples 0 to `last` are known: (batch,).

    The bound holds for all continuations of these samples.

    Args:
        formulas: formulas in negation normal form.
        columns: name -> samples, (time, batch), as many as the longest formula needs.
        last: index of the last known sample, one number or (batch,).
    """
    like = next(iter(columns.values()))
    index = torch.arange(len(like), device=like.device)[:, None].expand(like.shape)
    env = {**columns, BEYOND: torch.where(index > last, 1.0, -1.0).to(like.dtype)}
    margins = evaluate([open_ended(formula) for formula in formulas], env, ops=TORCH)
    return torch.stack([margin[0].expand(like.shape[1]) for margin in margins]).amin(0)


def prefix_robustness(formulas: Sequence[ir.Formula], columns: Mapping[str, Tensor]) -> Tensor:
    """Upper bound on the least robustness of `formulas`, given only the first samples of a trace.

    Args:
        formulas: the safety requirements.
        columns: name -> samples, (time, batch).

    Returns:
        (time, batch). Entry k is the bound over all continuations of the samples 0 to k. So entries never
        increase over time. A predicate on the initial state counts as true or false; its value does not enter
        the bound. Without formulas, all entries are +inf.
    """
    like = next(iter(columns.values()))
    bounds = [prefix_bounds(anchored(formula), columns) for formula in formulas]
    return torch.stack(bounds).amin(0) if bounds else torch.full_like(like, torch.inf)


def copied(formula: ir.Formula) -> bool:
    """True if `prefix_bounds` evaluates a copy of the trace for each of its prefixes."""
    match formula:
        case ir.BoolOp(_, items):
            return any(map(copied, items))
        case ir.Temporal("always", _, body):
            return not all(isinstance(node, (ir.Predicate, ir.BoolOp, ir.Truth)) for node in body.walk())
        case _:
            return not isinstance(formula, ir.Predicate)


def prefix_bounds(formula: ir.Formula, columns: Mapping[str, Tensor]) -> Tensor:
    """`prefix_robustness` of one formula: (time, batch).

    An `always` over states is a running minimum, and a predicate is known from the first sample on. Of any
    other operator, each prefix is evaluated. A value that is no number makes all entries no number, as in
    exported controllers.
    """
    like = next(iter(columns.values()))
    steps, batch = like.shape
    match formula:
        case ir.Predicate():
            (value,) = evaluate([formula], columns, ops=TORCH)
            return torch.broadcast_to(value, (steps, batch))
        case ir.BoolOp(op, items) if not copied(formula):
            joined: Tensor = TORCH.join([prefix_bounds(item, columns) for item in items], PICKS[op])
            return joined
        case ir.Temporal("always", window, body) if not copied(formula):
            stop = steps if window.hi is None else min(window.hi + 1, steps)
            (values,) = evaluate([body], columns, ops=TORCH, start=window.lo, count=stop - window.lo)
            least = values.cummin(0).values
            before = torch.full_like(least[:1], torch.inf).expand(window.lo, -1)
            whole = torch.cat((before, least, least[-1:].expand(steps - stop, -1)))
            return torch.where(values.isnan().any(0), torch.nan, whole)
    index = torch.arange(steps, device=like.device)
    beyond = torch.where(index[:, None] > index, 1.0, -1.0)
    env = {name: column.repeat(1, steps) for name, column in columns.items()}
    env[BEYOND] = beyond.to(like.dtype).repeat_interleave(batch, 1)
    (margin,) = evaluate([open_ended(formula)], env, ops=TORCH)
    return torch.reshape(margin[0].expand(steps * batch), (steps, batch))
