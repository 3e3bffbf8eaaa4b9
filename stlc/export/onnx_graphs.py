"""The graphs of a controller: it decides, it judges, it says how far plans are safe.

What is between them, the paper's backup policy and the plans that are gone on with, is `stlc.runtime`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from stlc.compile.backends.onnx.ops import ONNX_OPS as ONNX
from stlc.compile.backends.onnx.sheet import BATCH, Sheet, Value, joined
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.export.onnx_judge import columns_of, deepened, falls, judged, rank
from stlc.export.onnx_policy import proposed
from stlc.export.onnx_rollout import assigned

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.controller.policies.policy import PlanNetwork
    from stlc.controller.problem.task import Task


def deciding(task: Task, network: PlanNetwork) -> dict[str, Value]:
    """`state` (batch, n) -> the best of the policy's plans and its verdict, all float64.

    `plan` (batch, T, m), `rho`, `safe` and `cost` (batch,), `requirements` (batch, R); where the
    specification adds states, `added` (batch, k), what they are one step later.

    Raises:
        Untranslatable: the task holds something that has no form as a graph.
    """
    state = Sheet().input("state", (BATCH, len(task.names)))
    plans = proposed(task, network, columns_of(state, task.names))
    table = _table(task, state, plans)
    return _shown(_picked(table, _best(table["rank"]))) | _added(task, state)


def following(task: Task, network: PlanNetwork) -> dict[str, Value]:
    """`state` and `begun`, what is left of a plan, -> the plan to follow, as `Guard` chooses, in one pass.

    The outputs of `deciding` are those of `begun` where it is gone on with, which `kept` (batch,) says: it
    satisfies the specification, and the policy's plan ranks no higher, or it keeps a promise better and
    better. `policy_plan` and `policy_rho` are what the policy planned.

    Raises:
        Untranslatable: the task holds something that has no form as a graph.
    """
    sheet = Sheet()
    state = sheet.input("state", (BATCH, len(task.names)))
    begun = sheet.input("begun", (BATCH, task.horizon, len(task.system.controls)))
    fresh = proposed(task, network, columns_of(state, task.names))
    count = fresh.shape[1]
    table = _table(task, state, joined([fresh, begun.reshaped(BATCH, 1, *begun.shape[1:])], axis=1))
    best = _best(table["rank"].T[:count].T)
    policy = _picked(table, best)
    better = ONNX.ge(_one(table["rank"], count), policy["rank"])
    if task.promises.items:
        better = ONNX.either(better, _one(table["deepened"], count))
    kept = ONNX.both(better, ONNX.ge(_one(table["rho"], count), -TOLERANCE))
    index = kept.reshaped(BATCH, 1).apply("Where", sheet.constant([[count]], "int64"), best, kind="int64")
    shown = {"kept": kept, "policy_plan": policy["plan"], "policy_rho": policy["rho"]}
    return _shown(_picked(table, index)) | shown | _added(task, state)


def _table(task: Task, state: Value, plans: Value) -> dict[str, Value]:
    """`rank`, `plan` and verdicts of several plans (batch, count, T, m) of every agent: (batch, count, …)."""
    names = task.names
    count, steps, controls = plans.shape[1:]
    each = state.T.reshaped(len(names), BATCH, 1).spread(len(names), BATCH, count, like=state.T)
    starts = dict(zip(names, each.reshaped(len(names), BATCH).rows(), strict=True))
    found = judged(task, starts, plans.reshaped(BATCH, steps, controls))
    rows = {"rank": rank(found), "rho": found.rho, "safe": found.safe, "cost": found.cost}
    if task.promises.items:
        rows["deepened"] = deepened(task, found.states)
    table = {name: row.reshaped(BATCH, count) for name, row in rows.items()}
    requirements = joined(found.each).T.reshaped(BATCH, count, len(found.each))
    return {**table, "requirements": requirements, "plan": plans}


def _best(score: Value) -> Value:
    """Which plan ranks first, (batch, 1)."""
    (best,) = score.sheet.emit("ArgMax", (score,), [(BATCH, 1)], "int64", {"axis": 1, "keepdims": 1})
    return best


def _picked(table: Mapping[str, Value], index: Value) -> dict[str, Value]:
    """One row of the table of every agent, by (batch, 1): (batch, …)."""
    outputs = {}
    for name, values in table.items():
        shape = (BATCH, *values.shape[2:])
        (outputs[name],) = values.sheet.emit(
            "GatherND", (values, index), [shape], values.kind, {"batch_dims": 1}
        )
    return outputs


def _shown(picked: Mapping[str, Value]) -> dict[str, Value]:
    return {name: picked[name] for name in ("plan", "rho", "safe", "cost", "requirements")}


def _one(values: Value, place: int) -> Value:
    """The same plan of every agent: (batch, count, …) -> (batch, …)."""
    shape = (BATCH, *values.shape[2:])
    index = values.sheet.constant(place, "int64")
    (out,) = values.sheet.emit("Gather", (values, index), [shape], values.kind, {"axis": 1})
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

    `rho`, `safe` and `cost` (batch,), `requirements` (batch, R), `states` (batch, T + 1, n).

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
