"""ONNX graphs of a controller: rollout, policy, verdicts on plans, and safety of their first steps.

`stlc.runtime` runs the graphs. It also contains the search of the guard (Meng and Fan 2023) and stores the
previous plans.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from torch import Tensor

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.onnx.graph import BATCH, OnnxGraph, Value, joined
from stlc.compile.backends.onnx.ops import ONNX, ONNX_OPS, Columns, build_graph, require_numbers
from stlc.compile.ir import nodes as ir
from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.kinds.exact import Exact
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.safe_prefix import BEYOND, anchored, open_ended
from stlc.controller.policies.policy import ClosedLoopActor, PlanProposer
from stlc.controller.problem.task import Task
from stlc.dynamics.declaration.schema.names import ControlDecl
from stlc.dynamics.model.controls import raw_width, shares
from stlc.dynamics.model.rollout import Stepper
from stlc.dynamics.model.step import ModelStep
from stlc.export.description import (
    control_images,
    observation,
    state_images,
)
from stlc.runtime.decision import rank

# --------------------------------------------------------------------------------------------- rollout


def rollout(step: ModelStep, start: Mapping[str, Value], controls: Mapping[str, Value]) -> Columns:
    """Return the states under plans. Conditions in the dynamics are evaluated exactly, without smoothing.

    Args:
        step: one step of the system.
        start: state name -> initial value, (1, batch).
        controls: control name -> values, (steps, batch).

    Returns:
        State name -> values, (steps + 1, batch).

    Raises:
        Untranslatable: the step calls a Python function.
    """
    require_numbers(step.numbers.values())
    return Stepper(step).rollout(start, controls, len(next(iter(controls.values()))), ONNX)


def assigned(numbers: Mapping[str, ir.Num], columns: Mapping[str, Value]) -> Columns:
    """Evaluate the expressions `numbers` on the signals `columns`.

    Returns name of the expression -> value. The shape of a value may have length 1 in some dimensions in
    which the signals are longer (broadcasting).

    Raises:
        Untranslatable: an expression calls a Python function.
    """
    require_numbers(list(numbers.values()))
    return ArrayProgram(dict(numbers))(columns, ONNX) if numbers else {}


# ---------------------------------------------------------------------------------------------- policy


def proposed(task: Task, network: PlanProposer, state: Mapping[str, Value]) -> Value:
    """Return all plans that a network proposes; those of an actor are its closed loop on the model.

    Args:
        task: the task that the network was trained for.
        network: the network, in float32 as in training.
        state: state name -> value, (1, batch).

    Returns:
        (batch, plans, T, m) float64.

    Raises:
        Untranslatable: the expression of an observation or of a mirrored value calls a Python function.
    """
    if isinstance(network, ClosedLoopActor):
        return _closed_loop(task, network, state)
    folded, swapped = _folded(task, network, state)
    raw = _layers(network, _observed(task, folded).T.cast("float32"))
    raw = raw.reshaped(BATCH, network.plans, task.horizon, raw_width(task.system.decl.controls))
    if network.clock is not None:  # outputs are a plan for the whole mission: what is left of it now
        elapsed = list(state.values())[network.clock].reshaped(BATCH, 1, 1, 1)
        steps = raw.graph.constant([[[[float(k)] for k in range(task.horizon)]]])
        index = ONNX_OPS.clamp(elapsed + steps, 0.0, task.horizon - 1.0).cast("int64")
        index = index.expand(*raw.shape, like=next(iter(state.values())))
        (raw,) = raw.graph.emit("GatherElements", (raw, index), [raw.shape], raw.kind, {"axis": 2})
    controls = _squashed(task.system.decl.controls, raw.transposed(3, 0, 1, 2).rows())
    if swapped is not None:
        mask = swapped.reshaped(1, BATCH, 1, 1)
        images = assigned(control_images(task), controls)
        controls = {name: ONNX_OPS.where(mask, images[name], value) for name, value in controls.items()}
    return joined(list(controls.values())).transposed(1, 2, 3, 0).cast("float64")


def _closed_loop(task: Task, network: ClosedLoopActor, state: Mapping[str, Value]) -> Value:
    """Controls of an actor over the horizon, each step from the states that it has reached.

    Arguments and result are those of `proposed`, with one plan per agent.
    """
    require_numbers(task.system.exact_step.numbers.values())
    stepper = Stepper(task.system.exact_step)
    still = [name for name in state if name not in stepper.moving]

    def step(now: Sequence[Value], rows: Sequence[Value]) -> tuple[list[Value], list[Value]]:
        elapsed, *given = rows
        env = dict(zip((*still, *stepper.moving), (*given, *now), strict=True))
        seen = joined([_observed(task, env), elapsed.expand(1, BATCH, like=now[0])])
        raw = _squashed(network.outputs, _layers(network, seen.T.cast("float32")).T.rows())
        actions = {
            each.name: ONNX_OPS.clamp(raw[each.name].cast("float64"), each.low, each.high)
            for each in network.outputs
        }
        return list(stepper.step(env | actions, ONNX).values()), list(actions.values())

    carry = [state[name] for name in stepper.moving]
    elapsed = carry[0].graph.constant([[k / task.horizon] for k in range(task.horizon)])
    rows = [elapsed, *(state[name] for name in still)]
    controls = [joined(parts) for parts in ONNX_OPS.scan(step, carry, rows, task.horizon)]
    planes = [each.reshaped(1, task.horizon, BATCH) for each in controls]
    return joined(planes).transposed(2, 1, 0).reshaped(BATCH, 1, task.horizon, len(controls))


def _folded(
    task: Task, network: PlanProposer, state: Mapping[str, Value]
) -> tuple[Mapping[str, Value], Value | None]:
    """Replace states on one side of the system's mirror symmetry by their mirror images.

    The network was trained only for states on the other side. Returns the states by name, and the mask (1,
    batch) of the states that were replaced. The mask is None if the system has no symmetry.
    """
    if network.mirror is None:
        return state, None
    moved = assigned(state_images(task), state)
    side = task.system.names[network.mirror.side]
    swapped = ONNX_OPS.gt(moved[side], state[side])
    folded = {name: ONNX_OPS.where(swapped, moved[name], state[name]) for name in moved}
    return {**state, **folded}, swapped


def _observed(task: Task, state: Mapping[str, Value]) -> Value:
    """Observations of the network, (k, batch) float64."""
    numbers = observation(task)
    seen = assigned({str(place): number for place, number in enumerate(numbers)}, state)
    like = next(iter(state.values()))
    rows = [seen[str(place)].expand(1, BATCH, like=like) for place in range(len(numbers))]
    return joined(rows)


def _layers(network: PlanProposer, seen: Value) -> Value:
    """Outputs of the feed-forward network, (batch, outputs), for observations (batch, k), both float32."""
    layers = network.layers
    x = (seen - _weights(seen, layers.centre)) / _weights(seen, layers.spread)
    if math.isfinite(layers.bound):
        x = ONNX_OPS.clamp(x, -layers.bound, layers.bound)
    for place, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        if place:
            x = x.apply({"relu": "Relu", "tanh": "Tanh"}[layers.activation])
        parts = (x, _weights(seen, weight), _weights(seen, bias))
        (x,) = seen.graph.emit("Gemm", parts, [(BATCH, len(bias))], "float32", {"transB": 1})
    return x


def _weights(like: Value, tensor: Tensor) -> Value:
    return like.graph.constant(tensor.detach().numpy(force=True), "float32")


def _squashed(controls: Sequence[ControlDecl], raw: Sequence[Value]) -> dict[str, Value]:
    """Values of controls in physical units, by name, from the columns of the network's output."""
    return {
        each.name: share * ((each.high - each.low) / 2) + (each.low + each.high) / 2
        for each, share in zip(controls, shares(raw, tuple(controls), ONNX), strict=True)
    }


# -------------------------------------------------------------------------------------------- verdicts


States: TypeAlias = Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class Verdicts:
    """Verdicts on a batch of plans.

    A robustness is -inf if the plan or a value computed from it is not a number.

    Attributes:
        rho: robustness, (1, batch).
        safe: robustness of the safety requirements alone, (1, batch).
        each: robustness of every requirement, in order, (1, batch) each.
        cost: cost of the plans, (1, batch).
        states: state name -> values under the plans, (T + 1, batch).
    """

    rho: Value
    safe: Value
    each: tuple[Value, ...]
    cost: Value
    states: States


def columns_of(state: Value, names: Sequence[str]) -> dict[str, Value]:
    """Split states (batch, n) into one value (1, batch) per name."""
    return dict(zip(names, state.T.rows(), strict=True))


def inputs_of(plans: Value, task: Task) -> dict[str, Value]:
    """Split plans (batch, T, m) into one value (T, batch) per control."""
    rows = plans.transposed(2, 1, 0).rows()
    return {
        name: row.reshaped(task.horizon, BATCH)
        for name, row in zip(task.system.control_names, rows, strict=True)
    }


def judged(task: Task, start: States, plans: Value) -> Verdicts:
    """Evaluate plans (batch, T, m) from states (1, batch) as `Task.judge` and `Task.cost` do.

    Raises:
        Untranslatable: a part of the task has no ONNX form.
    """
    like = next(iter(start.values()))
    controls = inputs_of(plans, task)
    states = rollout(task.system.exact_step, start, controls)
    margins = build_graph([rule.formula for rule in task.rules], states)
    margins = [margin.expand(1, BATCH, like=like) for margin in margins]
    broken = _broken(task, plans, states, margins)
    each = tuple(ONNX_OPS.where(broken, -math.inf, margin) for margin in margins)
    by_name = dict(zip((rule.name for rule in task.rules), each, strict=True))
    rho = _overall(task.rules, by_name, like)
    safe = ONNX_OPS.where(broken, -math.inf, _overall(task.compiled.safety, by_name, like))
    require_numbers(part for term in task.plan_cost.terms for part in (term.number, term.value))
    sat = ONNX_OPS.full((1, 1), 1.0, rho)  # terms that depend on satisfaction are computed as if it were so
    cost = task.plan_cost(states, controls, sat, rho, ONNX)
    return Verdicts(rho, safe, each, cost.expand(1, BATCH, like=rho), states)


def _overall(rules: Sequence[CompiledRequirement], each: States, like: Value) -> Value:
    """Weighted minimum of the robustness of `rules`, (1, batch); +inf without requirements.

    `each` maps the name of a requirement to its robustness. `like` is any array of the batch; it determines
    the size of the batch.
    """
    if not rules:
        return like.graph.constant([[math.inf]]).expand(1, BATCH, like=like)
    factors = (rule.factor for rule in rules)
    least: Value = TOLERANCE.overall([each[rule.name] for rule in rules], factors, ONNX, Exact())
    return least


def _broken(task: Task, plans: Value, states: States, margins: Sequence[Value]) -> Value:
    """Mask of the plans whose verdict is invalid because a value is not finite: (1, batch).

    It is True if a plan contains a number that is not finite, or if a state in `states` or a robustness in
    `margins` is NaN.
    """
    nothing = _reduced("ReduceSum", plans * 0.0, (1, 2)).reshaped(1, BATCH)
    moving = [states[name] for name in task.system.exact_step.next]
    like = next(iter(states.values()))
    wide = [column.expand(column.shape[0], BATCH, like=like) for column in (*moving, *margins)]
    together = joined([nothing, *wide])
    lost = together.apply("IsNaN", kind="bool").cast("float32")
    return _reduced("ReduceMax", lost, (0,)).apply("Greater", 0.5, kind="bool")


def _reduced(op: str, x: Value, axes: tuple[int, ...]) -> Value:
    """Apply the ONNX reduction `op`, such as `ReduceSum`, to `x` over `axes`.

    The reduced axes are retained with length 1.
    """
    shape = tuple(1 if place in axes else length for place, length in enumerate(x.shape))
    (out,) = x.graph.emit(op, (x, x.graph.constant(axes, "int64")), [shape], x.kind, {"keepdims": 1})
    return out


# ------------------------------------------------------------------------ prefixes


def falls(task: Task, start: States, plans: Value) -> Value:
    """Robustness of the safety requirements on every prefix (first steps) of each plan: (T + 1, batch).

    The result equals `stlc.controller.guard.safe_prefix.prefix_robustness`. In the computation every prefix
    is a separate trajectory, so arrays are (T + 1, prefixes * batch).
    """
    rows = task.horizon + 1
    states = rollout(task.system.exact_step, start, inputs_of(plans, task))
    like = next(iter(start.values()))
    prefixes = [[[1.0 if k > end else -1.0] for end in range(rows)] for k in range(rows)]
    beyond = like.graph.constant(prefixes).expand(rows, rows, BATCH, like=like)
    columns = {
        name: column.expand(rows, BATCH, like=like)
        .reshaped(rows, 1, BATCH)
        .expand(rows, rows, BATCH, like=like)
        for name, column in states.items()
    }
    columns[BEYOND] = beyond
    flat = {name: column.reshaped(rows, BATCH) for name, column in columns.items()}
    formulas = [open_ended(anchored(rule.formula)) for rule in task.compiled.safety]
    margins = build_graph(formulas, flat)
    least = ONNX_OPS.join([margin.expand(1, BATCH, like=flat[BEYOND]) for margin in margins], "min")
    found: Value = least.reshaped(rows, BATCH)
    return found


# ---------------------------------------------------------------------------------------------- graphs


def deciding(task: Task, network: PlanProposer, *, varied: bool = True) -> dict[str, Value]:
    """Graph from `state` (batch, n) to the best of the policy's plans and its verdict, all float64.

    If the best plan of the network violates the specification, copies of it with small changes are tried,
    too. If `varied` is False, no copies are tried: the plan is that of `Policy.continuation`.

    Outputs are `plan` (batch, T, m), `rho`, `safe` and `cost` (batch,), and `requirements` (batch, R). If the
    specification adds states, the output `added` (batch, k) holds these states one step later.

    Raises:
        Untranslatable: a part of the task has no ONNX form.
    """
    state = OnnxGraph().input("state", (BATCH, len(task.system.names)))
    table = _table(task, state, proposed(task, network, columns_of(state, task.system.names)))
    policy = _picked(table, _best(table["rank"]))
    return _shown(_varied(task, network, state, policy) if varied else policy) | _added(task, state)


def following(task: Task, network: PlanProposer) -> dict[str, Value]:
    """Graph from `state` (batch, n) and `begun` (batch, T, m) to the plan that `Guard` chooses.

    `begun` is the rest of the previous plan. It is kept if it satisfies the specification and one of two
    conditions holds: the policy's plan ranks no higher, or the next step of `begun` increases the robustness
    of a goal that is satisfied now. Otherwise the policy's plan is chosen.

    The outputs of `deciding` are returned for the chosen plan. Further outputs are `kept` (batch,), which
    tells whether `begun` was kept, and the policy's plan and its robustness, `policy_plan` and `policy_rho`.

    Raises:
        Untranslatable: a part of the task has no ONNX form.
    """
    graph = OnnxGraph()
    state = graph.input("state", (BATCH, len(task.system.names)))
    previous = graph.input("begun", (BATCH, task.horizon, len(task.system.decl.controls)))
    fresh = proposed(task, network, columns_of(state, task.system.names))
    count = fresh.shape[1]
    table = _table(task, state, joined([fresh, previous.reshaped(BATCH, 1, *previous.shape[1:])], axis=1))
    policy = _varied(task, network, state, _picked(table, _best(table["rank"].T[:count].T)))
    index, rest = graph.constant(count, "int64"), {}
    for name, values in table.items():
        shape = (BATCH, *values.shape[2:])
        (rest[name],) = graph.emit("Gather", (values, index), [shape], values.kind, {"axis": 1})
    better = ONNX_OPS.ge(rest["rank"], policy["rank"])
    if task.pending_goals.items:
        better = ONNX_OPS.either(better, rest["deepened"])
    kept = ONNX_OPS.both(better, TOLERANCE.satisfied(rest["rho"]))
    chosen = {
        name: ONNX_OPS.where(kept.reshaped(BATCH, *[1] * (len(own.shape) - 1)), rest[name], own)
        for name, own in _shown(policy).items()
    }
    shown = {"kept": kept, "policy_plan": policy["plan"], "policy_rho": policy["rho"]}
    return chosen | shown | _added(task, state)


def _varied(task: Task, network: PlanProposer, state: Value, policy: Mapping[str, Value]) -> dict[str, Value]:
    """Replace each plan that violates the specification by a changed copy, if one ranks higher.

    A changed copy is the plan plus one of the changes that the network declares. The copies are judged only
    if the plan of at least one agent violates the specification.

    `policy` holds the results for the best plan of the network, by name, (batch, …) each. The results `plan`,
    `rank`, `rho`, `safe`, `cost` and `requirements` of the chosen plans are returned.
    """
    names = ("plan", "rank", "rho", "safe", "cost", "requirements")
    if not len(network.changes):
        return {name: policy[name] for name in names}
    bounds = task.system.control_low, task.system.control_high

    def changed(graph: OnnxGraph) -> Sequence[Value]:
        own = {name: policy[name].on(graph) for name in names}
        plan = own["plan"].reshaped(BATCH, 1, *own["plan"].shape[1:])
        numbers = (network.changes[None], *bounds)
        changes, low, high = (graph.constant(each.double().numpy()) for each in numbers)
        plans = joined([plan, (plan + changes).apply("Max", low).apply("Min", high)], axis=1)
        table = _table(task, state.on(graph), plans)
        better = _picked(table, _best(table["rank"]))
        good = TOLERANCE.satisfied(own["rho"])
        return [
            ONNX_OPS.where(good.reshaped(BATCH, *[1] * (len(own[name].shape) - 1)), own[name], better[name])
            for name in names
        ]

    def as_proposed(graph: OnnxGraph) -> Sequence[Value]:
        return [policy[name].on(graph).apply("Identity") for name in names]

    least = _reduced("ReduceMin", policy["rho"], (0,))
    fails = TOLERANCE.violated(least).reshaped()
    found = state.graph.branched(fails, changed, as_proposed)
    return dict(zip(names, found, strict=True))


def _table(task: Task, state: Value, plans: Value) -> dict[str, Value]:
    """Evaluate several plans per agent: `plans` is (batch, count, T, m), `state` (batch, n).

    Returns name of a result -> values, (batch, count, …). The results are `rank`, `rho`, `safe`, `cost`,
    `requirements`, and `plan` (the plans themselves). If the task has goals, there is also the result
    `deepened`.
    """
    names = task.system.names
    count, steps, controls = plans.shape[1:]
    each = state.T.reshaped(len(names), BATCH, 1).expand(len(names), BATCH, count, like=state.T)
    starts = dict(zip(names, each.reshaped(len(names), BATCH).rows(), strict=True))
    found = judged(task, starts, plans.reshaped(BATCH, steps, controls))
    rows = {"rho": found.rho, "safe": found.safe, "cost": found.cost}
    rows["rank"] = rank(found.rho, found.cost, found.safe, ONNX)
    if task.pending_goals.items:
        rows["deepened"] = task.pending_goals.deepened(found.states, ONNX)
    table = {name: row.reshaped(BATCH, count) for name, row in rows.items()}
    requirements = joined(found.each).T.reshaped(BATCH, count, len(found.each))
    return {**table, "requirements": requirements, "plan": plans}


def _best(score: Value) -> Value:
    """Index of the plan with the highest rank for each agent, (batch, 1); `score` holds the ranks."""
    (best,) = score.graph.emit("ArgMax", (score,), [(BATCH, 1)], "int64", {"axis": 1, "keepdims": 1})
    return best


def _picked(table: Mapping[str, Value], index: Value) -> dict[str, Value]:
    """Select one plan of each agent from the results in `table`: (batch, count, …) -> (batch, …).

    `index` (batch, 1) is the number of the plan.
    """
    outputs = {}
    for name, values in table.items():
        shape = (BATCH, *values.shape[2:])
        (outputs[name],) = values.graph.emit(
            "GatherND", (values, index), [shape], values.kind, {"batch_dims": 1}
        )
    return outputs


def _shown(picked: Mapping[str, Value]) -> dict[str, Value]:
    return {name: picked[name] for name in ("plan", "rho", "safe", "cost", "requirements")}


def _added(task: Task, state: Value) -> dict[str, Value]:
    """Graph output `added`: the states that the specification adds, one step after `state`.

    These states are parameters and timers. The result is an empty mapping if the specification adds none.
    """
    if not task.system.added:
        return {}
    now = columns_of(state, task.system.names)
    later = now | assigned({timer.name: timer.update for timer in task.system.timers}, now)
    like = now[task.system.names[0]]
    rows = [later[column.name].expand(1, BATCH, like=like) for column in task.system.added]
    return {"added": joined(rows).T}


def judging(task: Task) -> dict[str, Value]:
    """Graph from `state` (batch, n) and `plan` (batch, T, m) to verdicts, and to the states under the plan.

    Outputs are `rho`, `safe` and `cost` (batch,), `requirements` (batch, R), and `states` (batch, T + 1, n).

    Raises:
        Untranslatable: a part of the task has no ONNX form.
    """
    start, plans = _asked(task)
    found = judged(task, start, plans)
    like = next(iter(start.values()))
    rows = task.horizon + 1
    wide = [found.states[name].expand(rows, BATCH, like=like) for name in task.system.names]
    outputs = {"rho": found.rho, "safe": found.safe, "cost": found.cost}
    outputs = {name: value.reshaped(BATCH) for name, value in outputs.items()}
    outputs["requirements"] = joined(found.each).T
    states = joined(wide).reshaped(len(task.system.names), rows, BATCH)
    outputs["states"] = states.transposed(2, 1, 0)
    return outputs


def falling(task: Task) -> dict[str, Value]:
    """Graph from `state` (batch, n) and `plan` (batch, T, m) to the output `falls` (batch, T + 1).

    `falls` is the robustness of the safety requirements on every prefix (first steps) of the plan.

    Raises:
        Untranslatable: a part of the task has no ONNX form.
    """
    start, plans = _asked(task)
    return {"falls": falls(task, start, plans).T}


def _asked(task: Task) -> tuple[Mapping[str, Value], Value]:
    graph = OnnxGraph()
    state = graph.input("state", (BATCH, len(task.system.names)))
    plans = graph.input("plan", (BATCH, task.horizon, len(task.system.decl.controls)))
    return columns_of(state, task.system.names), plans
