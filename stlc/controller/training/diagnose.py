"""Diagnosis of training steps that are not finite, and of mirror symmetries that a system lacks.

A training step computes, in this order: plans from the network, states, the robustness of each requirement
and the performance terms, gradients. The first quantity that is not finite is reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.training.objective import Objective, rolled, without_lost
from stlc.diagnostics import RunError, StlcError, SystemFileError
from stlc.dynamics.system import System

if TYPE_CHECKING:
    from stlc.controller.policies.policy import PlanNetwork

SHOWN = 6
"""Maximum number of entries of a plan in messages."""


@dataclass(frozen=True, slots=True)
class TrainingStep:
    """Inputs of a training step.

    Attributes:
        task: problem that is trained for.
        objective: the minimised loss.
        x0: initial states, (B, n).
        u: the network's plans, (B, T, m).
        number: index of the step.
    """

    task: Task
    objective: Objective
    x0: Tensor
    u: Tensor
    number: int

    @classmethod
    def of(
        cls, network: PlanNetwork, objective: Objective, x0: Tensor, number: int, task: Task
    ) -> TrainingStep:
        """Make the training step number `number`, on all plans that `network` proposes from `x0`, (B, n)."""
        with torch.no_grad():
            plans = network(x0)
        return cls(task, objective, x0.repeat_interleave(plans.shape[1], 0), plans.flatten(0, 1), number)


def diagnose(step: TrainingStep) -> StlcError:
    """Find the first quantity of a training step that is not finite, and return the error that reports it."""
    for check in (_plans, _motion, _robustness, _cost):
        found = check(step)
        if found is not None:
            return found
    return RunError.of(
        "R401",
        f"training diverged: the loss or its gradient is not finite at step {step.number}",
        help=("try a smaller --lr; `stlc compile` shows the dynamics that are rolled out",),
    )


def _plans(step: TrainingStep) -> StlcError | None:
    row = _first(~torch.isfinite(step.u).flatten(1).all(1))
    if row is None:
        return None
    return RunError.of(
        "R401",
        f"training diverged: at step {step.number} the network's plans are no numbers",
        help=("try a smaller --lr",),
        note=(f"for the start {_state(step, row)}",),
    )


def _motion(step: TrainingStep) -> StlcError | None:
    with torch.no_grad():
        states = step.task.system.rollout(step.x0, step.u)
    bad = ~torch.isfinite(states)
    row = _first(bad.flatten(1).any(1))
    if row is None:
        return None
    when = int(bad[row].any(1).nonzero()[0])
    name = step.task.system.names[int(bad[row, when].nonzero()[0])]
    what = "NaN" if bool(states[row, when].isnan().any()) else "infinity"
    then = f"{when} step{'s' * (when > 1)} ({when * step.task.system.dt:.3g} s) after a start"
    return SystemFileError.of(
        "S302",
        f"the dynamics of {step.task.system.decl.name} give {what} in `{name}`, {then}",
        step.task.system.decl.places.get(name),
        label="declared here",
        help=("clamp the state, shorten the step, or keep divisors away from 0",),
        note=(f"from {_state(step, row)}", f"with {_plan(step, row, when)}", _at(step)),
    )


def _robustness(step: TrainingStep) -> StlcError | None:
    """Error that names a requirement whose robustness or gradient is not finite although the states are.

    None if there is no such requirement.

    The values of all requirements are checked before the gradients, since one infinite value makes the
    gradients of all requirements infinite or NaN.
    """
    rules = step.task.rules
    checks = [_differentiated(step, partial(_pursued, step, index)) for index in range(len(rules))]
    for what, bad_of, way in _WRONG:
        for rule, check in zip(rules, checks, strict=True):
            row = _first(bad_of(*check))
            if row is not None:
                return RunError.of(
                    "R401",
                    f"the {what.format(rule.name)} on states that are",
                    rule.span,
                    label="this requirement",
                    help=(way,),
                    note=(f"from {_state(step, row)}", f"with {_plan(step, row)}", _at(step)),
                )
    return None


def _cost(step: TrainingStep) -> StlcError | None:
    """Error that names a performance term whose value or gradient is not finite; None if there is none."""
    declared = step.task.system.decl
    for term in declared.objective.terms:
        alone = replace(declared, objective=replace(declared.objective, terms=(term,)))
        task = Task(step.task.compiled, System(alone))

        def cost(u: Tensor, task: Task = task) -> Tensor:
            each, columns = rolled(step.task, step.objective, step.x0, u)
            return task.system.performance(
                columns, torch.ones(len(u)).to(u), step.task.graph.overall(each), u
            )

        value, slope = _differentiated(step, cost)
        row = _first(~torch.isfinite(value) | ~_finite(slope))
        if row is not None:
            return RunError.of(
                "R401",
                f"the performance term `{term.name}`, or its gradient, is not a number",
                help=("a root, a power, a logarithm or a quotient has no slope at 0: keep away from it",),
                note=(f"from {_state(step, row)}", f"with {_plan(step, row)}", _at(step)),
            )
    return None


def _pursued(step: TrainingStep, index: int, u: Tensor) -> Tensor:
    """Robustness of the plans `u` for requirement number `index`, (B,); +inf where it is lost."""
    each, _ = rolled(step.task, step.objective, step.x0, u)
    return without_lost(step.task, each)[:, index]


def _differentiated(step: TrainingStep, value_of: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Values of the plans, (B,), and gradients of the values with respect to the plans, (B, T, m).

    `value_of`: function from plans to values.
    """
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
"""Possible faults of a requirement's value and gradient: test, message and remedy of each."""


def _first(marks: Tensor) -> int | None:
    rows = marks.nonzero()
    return int(rows[0]) if len(rows) else None


def _state(step: TrainingStep, row: int) -> str:
    columns = zip(step.task.system.signature.columns, step.x0[row].tolist(), strict=True)
    return ", ".join(
        f"{column.name} = {value:.4g} {column.unit}".removesuffix(" 1") for column, value in columns
    )


def _plan(step: TrainingStep, row: int, steps: int | None = None) -> str:
    shown = min(SHOWN, step.u.shape[1] if steps is None else max(steps, 1))
    values = zip(step.task.system.control_names, step.u[row, :shown].t().tolist(), strict=True)
    more = ", …" if shown < step.u.shape[1] else ""
    return "; ".join(f"{name} = {', '.join(f'{value:.4g}' for value in line)}{more}" for name, line in values)


def _at(step: TrainingStep) -> str:
    return f"at training step {step.number}"


SAMPLES = 1024
NEAR = 1e-6
"""Rounding tolerance, relative to 1 or to the value, whichever is larger."""
ODD = 0.02
"""Share of samples that may disagree, since rounding decides conditions that are nearly tied."""


def check_mirror(task: Task) -> None:
    """Check the mirror symmetry that a system file declares, on random states and plans.

    Raises:
        SystemFileError: S304, system or specification are not symmetric.
    """
    mirror = task.system.mirror
    if mirror is None:
        return
    generator = torch.Generator().manual_seed(0)
    x0 = task.sample(SAMPLES, generator=generator, dtype=torch.float64)
    low, high = task.system.control_low.double(), task.system.control_high.double()
    shape = (SAMPLES, task.horizon, len(low))
    u = low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)
    image, there = mirror.states(x0), mirror.plans(u)
    _compare(task, task.system.names, mirror.states(image), x0, "the image of the image of a state")
    _compare(task, task.system.control_names, mirror.plans(there), u, "the image of the image of a control")
    one, two = task.judge(x0, u), task.judge(image, there)
    names = tuple(f"`{rule.name}`" for rule in task.rules)
    last = torch.stack([column[-1] for column in one.columns.values()], -1)
    moved = torch.stack([column[-1] for column in two.columns.values()], -1)
    _compare(task, task.system.names, moved, mirror.states(last), "where the image of a state gets to")
    there_true, here_true = (TOLERANCE.satisfied(each.requirements).double() for each in (two, one))
    _compare(task, names, there_true, here_true, "whether an image satisfies a requirement")


def _compare(task: Task, names: tuple[str, ...], found: Tensor, wanted: Tensor, what: str) -> None:
    """Raise SystemFileError (S304) if two arrays differ in more than a small share of the rows.

    A few rows may differ, because rounding decides conditions that are nearly tied.

    Args:
        task: specification and system.
        names: names of the last dimension.
        found: values that were computed, (…, len(names)).
        wanted: values that a mirror symmetry would give, of the same shape.
        what: description of the values, for the message. The message also gives the entry of `names` for
            which most rows differ.
    """
    found, wanted = found.reshape(-1, len(names)), wanted.reshape(-1, len(names))
    off = ~torch.isclose(found, wanted, rtol=NEAR, atol=NEAR, equal_nan=True)
    shares = off.double().mean(0)
    worst = int(shares.argmax())
    if float(shares[worst]) <= ODD:
        return
    row = int(off[:, worst].nonzero()[0])
    raise SystemFileError.of(
        "S304",
        f"the `mirror` of the policy is not a symmetry: {what} differs in {names[worst]}",
        task.system.decl.policy.mirror_span,
        "declared here",
        help=("write the image of every state and control that changes sides, or leave `mirror` out",),
        note=(
            f"{float(found[row, worst]):.6g} instead of {float(wanted[row, worst]):.6g} for one of "
            f"{SAMPLES} random states, and something of the kind for {float(shares[worst]):.0%} of them",
        ),
    )
