"""Why a training step gave no number: the first link of the chain that broke, for which start and which plan.

The chain: network -> plans -> states -> robustness of each requirement and performance terms -> gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.switch import Hard
from stlc.controller.problem.task import Task
from stlc.controller.training.objective import Objective, native_rolled
from stlc.diagnostics import Diagnostic, RunError, StlcError, SystemFileError
from stlc.dynamics.model.system import System

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.controller.policies.policy import PlanNetwork

HARD = Hard()
SHOWN = 6
"""Numbers of a plan that are told."""


@dataclass(frozen=True, slots=True)
class Step:
    """What a training step was made with.

    Attributes:
        task: that is trained for.
        objective: what was minimised.
        x0: where plans start, (B, n).
        u: the network's plans, (B, T, m).
        number: of the step.
    """

    task: Task
    objective: Objective
    x0: Tensor
    u: Tensor
    number: int

    @classmethod
    def of(cls, network: PlanNetwork, objective: Objective, x0: Tensor, number: int, task: Task) -> Step:
        """The step with all plans of the network for states (B, n)."""
        with torch.no_grad():
            plans = network(x0)
        return cls(task, objective, x0.repeat_interleave(plans.shape[1], 0), plans.flatten(0, 1), number)


def diagnose(step: Step) -> StlcError:
    """The first of what a training step needs that is no number, and where."""
    for look in (_plans, _motion, _robustness, _cost):
        found = look(step)
        if found is not None:
            return found
    return RunError(
        Diagnostic(
            "R401",
            f"training diverged: the loss or its gradient is not finite at step {step.number}",
            help=("try a smaller --lr; `stlc compile` shows the dynamics that are rolled out",),
        )
    )


def _plans(step: Step) -> StlcError | None:
    row = _first(~torch.isfinite(step.u).flatten(1).all(1))
    if row is None:
        return None
    return RunError(
        Diagnostic(
            "R401",
            f"training diverged: at step {step.number} the network's plans are no numbers",
            help=("try a smaller --lr",),
            note=(f"for the start {_state(step, row)}",),
        )
    )


def _motion(step: Step) -> StlcError | None:
    with torch.no_grad():
        states = step.task.system.rollout(step.x0, step.u, HARD)
    bad = ~torch.isfinite(states)
    row = _first(bad.flatten(1).any(1))
    if row is None:
        return None
    when = int(bad[row].any(1).nonzero()[0])
    name = step.task.names[int(bad[row, when].nonzero()[0])]
    what = "NaN" if bool(states[row, when].isnan().any()) else "infinity"
    then = f"{when} step{'s' * (when > 1)} ({when * step.task.dt:.3g} s) after a start"
    return SystemFileError(
        Diagnostic(
            "S302",
            f"the dynamics of {step.task.system.name} give {what} in `{name}`, {then}",
            step.task.system.decl.places.get(name),
            label="declared here",
            help=("clamp the state, shorten the step, or keep divisors away from 0",),
            note=(f"from {_state(step, row)}", f"with {_plan(step, row, when)}", _at(step)),
        )
    )


def _robustness(step: Step) -> StlcError | None:
    """A requirement whose value, or else whose gradient, is no finite number on states that are.

    A value that is infinite spoils the gradients of all requirements, so values come first.
    """
    looks = [
        _differentiated(step, lambda u, i=index: _each(step, u)[0][:, i])  # type: ignore[misc]
        for index in range(len(step.task.rules))
    ]
    for what, bad_of, way in _WRONG:
        for rule, look in zip(step.task.rules, looks, strict=True):
            row = _first(bad_of(*look))
            if row is not None:
                return RunError(
                    Diagnostic(
                        "R401",
                        f"the {what.format(rule.name)} on states that are",
                        rule.span,
                        label="this requirement",
                        help=(way,),
                        note=(f"from {_state(step, row)}", f"with {_plan(step, row)}", _at(step)),
                    )
                )
    return None


def _cost(step: Step) -> StlcError | None:
    """A performance term whose value or gradient is no number."""
    declared = step.task.system.decl
    for term in declared.objective.terms:
        alone = replace(declared, objective=replace(declared.objective, terms=(term,)))
        task = Task(step.task.compiled, System(alone))

        def cost(u: Tensor, task: Task = task) -> Tensor:
            each, columns = _each(step, u)
            return task.system.performance(
                columns, torch.ones(len(u)).to(u), step.task.graph.overall(each), u
            )

        value, slope = _differentiated(step, cost)
        row = _first(~torch.isfinite(value) | ~_finite(slope))
        if row is not None:
            return RunError(
                Diagnostic(
                    "R401",
                    f"the performance term `{term.name}`, or its gradient, is not a number",
                    help=("a root, a power, a logarithm or a quotient has no slope at 0: keep away from it",),
                    note=(f"from {_state(step, row)}", f"with {_plan(step, row)}", _at(step)),
                )
            )
    return None


def _each(step: Step, u: Tensor) -> tuple[Tensor, Mapping[str, Tensor]]:
    """Robustness per requirement (B, R) and states (T+1, B), differentiable as training has them."""
    native = native_rolled(step.task, step.objective, step.x0, u)
    if native is not None:
        return native
    columns = step.task.system.rollout_columns(step.x0, u, step.objective.switch)
    smoothing = step.objective.smoothing
    return step.task.graph.per_requirement_columns(columns, ops=TORCH, smoothing=smoothing), columns


def _differentiated(step: Step, value_of: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """A value per plan (B,) and its gradient by the plan, (B, T, m)."""
    u = step.u.detach().requires_grad_()
    value = value_of(u)
    if not value.requires_grad:
        return value.detach(), torch.zeros_like(u)
    (slope,) = torch.autograd.grad(value.sum(), u)
    return value.detach(), slope


def _finite(slope: Tensor) -> Tensor:
    return torch.isfinite(slope).flatten(1).all(1)


_ROOT = "a root, a power, a logarithm or a quotient has no slope at 0: keep away from it"
_ENDLESS = "no plan is better than another there: keep its numbers finite, with `clip` for one"
_WRONG: tuple[tuple[str, Callable[[Tensor, Tensor], Tensor], str], ...] = (
    ("robustness of `{}` is not a number", lambda value, _: value.isnan(), _ROOT),
    ("robustness of `{}` is minus infinity", lambda value, _: value == -torch.inf, _ENDLESS),
    ("gradient of `{}` is not a number", lambda _, slope: ~_finite(slope), _ROOT),
)
"""What can be wrong with the value and the gradient of a requirement, and the way out."""


def _first(marks: Tensor) -> int | None:
    rows = marks.nonzero()
    return int(rows[0]) if len(rows) else None


def _state(step: Step, row: int) -> str:
    columns = zip(step.task.system.signature.columns, step.x0[row].tolist(), strict=True)
    return ", ".join(
        f"{column.name} = {value:.4g} {column.unit}".removesuffix(" 1") for column, value in columns
    )


def _plan(step: Step, row: int, steps: int | None = None) -> str:
    shown = min(SHOWN, step.u.shape[1] if steps is None else max(steps, 1))
    values = zip(step.task.system.control_names, step.u[row, :shown].t().tolist(), strict=True)
    more = ", …" if shown < step.u.shape[1] else ""
    return "; ".join(f"{name} = {', '.join(f'{value:.4g}' for value in line)}{more}" for name, line in values)


def _at(step: Step) -> str:
    return f"at training step {step.number}"
