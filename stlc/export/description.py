"""Parts of a controller as expressions of the IR (the compiler's intermediate representation).

The C header and the ONNX graphs are made from these expressions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from stlc.compile.ir import nodes as ir
from stlc.controller.problem.pending_goals import HELD
from stlc.controller.problem.task import GOALS, GUIDANCE, SHORTFALL, Task
from stlc.dynamics.declaration.learning import START

REDUCED, MARGIN = ir.Signal("#reduced"), ir.Signal("#margin")


def observation(task: Task) -> list[ir.Num]:
    """Return the observation of the network, as expressions of the states."""
    system = task.system
    observed = system.decl.policy.observe or [ir.Signal(name) for name in system.decl.signature.names]
    return [*observed, *(ir.Signal(column.name) for column in system.added)]


def state_images(task: Task) -> dict[str, ir.Num]:
    """Return the states that the mirror symmetry of the system changes: name -> mirrored value.

    The mirrored value is an expression of the states, as in `{"y": -y}`. The key `mirror` of a system file
    declares the symmetry.
    """
    names = set(task.system.names)
    return {each.name: each.value for each in task.system.decl.policy.mirror if each.name in names}


def control_images(task: Task) -> dict[str, ir.Num]:
    """Return the mirrored value of every control under the symmetry of the system: name -> expression.

    The mirrored value of an unaffected control is the control itself. Angles are wrapped into their range.
    """
    images = {each.name: each.value for each in task.system.decl.policy.mirror}
    found: dict[str, ir.Num] = {}
    for each in task.system.decl.controls:
        image = images.get(each.name, ir.Signal(each.name))
        if each.squash == "angle":
            low = ir.Const(each.low)
            turned = ir.Op("mod", (ir.Op("sub", (image, low)), ir.Const(2.0 * math.pi)))
            image = ir.Op("add", (turned, low))
        found[each.name] = image
    return found


@dataclass(frozen=True, slots=True)
class CostTerm:
    """Summand of a plan's cost: an expression, averaged or maximised over samples.

    The expression `number` is evaluated at each sample. The mean or maximum of its values is called
    `REDUCED`. The summand is the expression `value`, which may use `REDUCED`.

    Attributes:
        number: expression that is evaluated at each sample. It may use the states, the states at the first
            sample (name with suffix `START`), the index `k` and time `t` of the sample, the robustness `rho`
            of the plan, the flag `sat` (1: the plan counts as satisfying), and `MARGIN`. If `samples` is the
            horizon, it may also use the controls.
        samples: number of samples, from the first on.
        greatest: True if `REDUCED` is the maximum of `number` over the samples, False if it is the mean.
        goal: formula whose robustness at a sample is called `MARGIN`; None if `MARGIN` is not used.
        value: the summand, an expression of `REDUCED`.
        condition: condition on the states at the first sample; if it is false, the summand is 0.
    """

    number: ir.Num
    samples: int
    greatest: bool = False
    goal: ir.Formula | None = None
    value: ir.Num = REDUCED
    condition: ir.Formula | None = None


def cost_terms(task: Task) -> Iterator[CostTerm]:
    """Yield the summands of a plan's cost, whose sum is `Task.cost`."""
    states, controlled = task.system.objective
    compiled, samples, goals = task.compiled, task.horizon + 1, task.pending_goals
    gamma = ir.Const(task.system.decl.objective.gamma)

    def shortfall(margin: ir.Num, weight: float) -> ir.Num:
        lack = ir.Op("clip", (ir.Op("sub", (gamma, margin)), ir.Const(0.0), gamma))
        return ir.Op("mul", (ir.Const(weight), lack))

    if states is not None:
        yield CostTerm(states, samples)
    if controlled is not None:
        yield CostTerm(controlled, task.horizon)
    for goal in goals.items:
        clock, status = ir.Signal(goals.clock), ir.Signal(goal.status + START)
        since = ir.Predicate(ir.Op("sub", (clock, ir.Const(goal.first))))
        until = ir.Predicate(ir.Op("sub", (ir.Const(goal.last), clock)))
        counted = ir.Where(ir.BoolOp("and", (since, until)), MARGIN, ir.Const(-math.inf))
        pending = ir.Predicate(ir.Op("sub", (ir.Const(HELD), ir.Op("abs", (status,)))), strict=True)
        yield CostTerm(
            counted,
            samples,
            greatest=True,
            goal=goal.body,
            value=shortfall(REDUCED, GOALS),
            condition=pending,
        )
    if compiled.guidance_cost is not None:
        yield CostTerm(ir.Op("mul", (ir.Const(GUIDANCE), compiled.guidance_cost)), samples)
    if compiled.timers:
        yield CostTerm(shortfall(ir.Signal("rho"), SHORTFALL), 1)
