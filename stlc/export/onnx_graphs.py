"""The graphs of a controller: it decides, it judges, it says how far plans are safe.

What is between them, the paper's backup policy and the plans that are gone on with, is `stlc.runtime`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from stlc.compile.sheet import BATCH, Sheet, Value, joined
from stlc.export.onnx_judge import columns_of, deepened, falls, judged, rank
from stlc.export.onnx_policy import proposed
from stlc.export.onnx_rollout import assigned

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.controller.policy import PlanNetwork
    from stlc.controller.task import Task


def deciding(task: Task, network: PlanNetwork) -> dict[str, Value]:
    """`state` (batch, n) -> the best of the policy's plans and its verdict, all float64.

    `plan` (batch, T, m), `rho`, `safe` and `cost` (batch,), `requirements` (batch, R); where the
    specification adds states, `added` (batch, k), what they are one step later.

    Raises:
        Untranslatable: the task holds something that has no form as a graph.
    """
    state = Sheet().input("state", (BATCH, len(task.names)))
    plans = proposed(task, network, columns_of(state, task.names))
    count, steps, controls = plans.shape[1:]
    each = state.T.reshaped(len(task.names), BATCH, 1).spread(len(task.names), BATCH, count, like=state.T)
    starts = dict(zip(task.names, each.reshaped(len(task.names), BATCH).rows(), strict=True))
    found = judged(task, starts, plans.reshaped(BATCH, steps, controls))
    score = rank(found).reshaped(BATCH, count)
    (best,) = score.sheet.emit("ArgMax", (score,), [(BATCH, 1)], "int64", {"axis": 1, "keepdims": 1})
    verdicts = {"rho": found.rho, "safe": found.safe, "cost": found.cost}
    outputs = {"plan": _picked(plans, best)}
    outputs |= {name: _picked(value.reshaped(BATCH, count), best) for name, value in verdicts.items()}
    table = joined(found.each).T.reshaped(BATCH, count, len(found.each))
    outputs["requirements"] = _picked(table, best)
    return outputs | _added(task, state)


def _picked(values: Value, index: Value) -> Value:
    """One of the rows of every agent: (batch, count, …) by (batch, 1) -> (batch, …)."""
    shape = (BATCH, *values.shape[2:])
    (out,) = values.sheet.emit("GatherND", (values, index), [shape], values.kind, {"batch_dims": 1})
    return out


def _added(task: Task, state: Value) -> dict[str, Value]:
    """Parameters and timers one step later."""
    if not task.system.added:
        return {}
    now = columns_of(state, task.names)
    later = now | assigned({timer.name: timer.update for timer in task.system.timers}, now)
    like = now[task.names[0]]
    rows = [later[column.name].spread(1, BATCH, like=like) for column in task.system.added]
    return {"added": joined(rows).T}


def judging(task: Task) -> dict[str, Value]:
    """`state` (batch, n) and `plan` (batch, T, m) -> verdicts, and the states under the plan.

    `rho`, `safe` and `cost` (batch,), `requirements` (batch, R), `states` (batch, T + 1, n); on a mission
    with promises `deepened` (batch,), whether the next step adds to what one has to spare.

    Raises:
        Untranslatable: the task holds something that has no form as a graph.
    """
    start, plans = _asked(task)
    found = judged(task, start, plans)
    like = next(iter(start.values()))
    rows = task.horizon + 1
    wide = [found.states[name].spread(rows, BATCH, like=like) for name in task.names]
    outputs = {"rho": found.rho, "safe": found.safe, "cost": found.cost}
    outputs = {name: value.reshaped(BATCH) for name, value in outputs.items()}
    outputs["requirements"] = joined(found.each).T
    states = joined(wide).reshaped(len(task.names), rows, BATCH)
    outputs["states"] = states.transposed(2, 1, 0)
    if task.promises.items:
        outputs["deepened"] = deepened(task, found.states).reshaped(BATCH)
    return outputs


def falling(task: Task) -> dict[str, Value]:
    """`state` and `plan` as in `judging` -> `falls` (batch, T + 1): phi_safe's robustness on every prefix.

    Raises:
        Untranslatable: the task holds something that has no form as a graph.
    """
    start, plans = _asked(task)
    return {"falls": falls(task, start, plans).T}


def _asked(task: Task) -> tuple[Mapping[str, Value], Value]:
    sheet = Sheet()
    state = sheet.input("state", (BATCH, len(task.names)))
    plans = sheet.input("plan", (BATCH, task.horizon, len(task.system.controls)))
    return columns_of(state, task.names), plans
