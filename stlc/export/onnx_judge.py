"""What becomes of plans, as a graph: states, robustness, phi_safe, what plans cost, how far they are safe."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING

from stlc.compile.backends.array.unrolled import written
from stlc.compile.backends.onnx.ops import ONNX_OPS as ONNX
from stlc.compile.backends.onnx.sheet import BATCH, Value, joined
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.safe_prefix import BEYOND, anchored, open_ended
from stlc.controller.problem.pending_goals import HELD
from stlc.controller.problem.task import KEPT, PULL, SHORT, TIE, Task
from stlc.dynamics.declaration.learning import START
from stlc.export.onnx_rollout import assigned, rolled

if TYPE_CHECKING:
    from stlc.compile.ir import nodes as ir
    from stlc.compile.pipeline import CompiledRequirement

Columns = Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class Verdicts:
    """What became of a batch of plans.

    Attributes:
        rho: (1, batch), -inf where a plan or what follows from it is no number.
        safe: the same of phi_safe.
        each: the same of every requirement, in order.
        cost: (1, batch).
        states: (T + 1, batch) each.
    """

    rho: Value
    safe: Value
    each: tuple[Value, ...]
    cost: Value
    states: Columns


def columns_of(state: Value, names: Sequence[str]) -> dict[str, Value]:
    """(batch, n) -> (1, batch) each."""
    return dict(zip(names, state.T.rows(), strict=True))


def inputs_of(plans: Value, task: Task) -> dict[str, Value]:
    """(batch, T, m) -> (T, batch) each."""
    rows = plans.transposed(2, 1, 0).rows()
    return {
        name: row.reshaped(task.horizon, BATCH)
        for name, row in zip(task.system.control_names, rows, strict=True)
    }


def judged(task: Task, start: Columns, plans: Value) -> Verdicts:
    """`Task.judge` and `Task.cost` of plans (batch, T, m) from states (1, batch) each.

    Raises:
        Untranslatable: the task holds something that has no form as a graph.
    """
    like = next(iter(start.values()))
    controls = inputs_of(plans, task)
    states = rolled(task.system.exact_step, start, controls)
    margins = written([rule.formula for rule in task.rules], states)
    margins = [margin.spread(1, BATCH, like=like) for margin in margins]
    broken = _broken(task, plans, states, margins)
    each = tuple(ONNX.where(broken, -math.inf, margin) for margin in margins)
    by_name = dict(zip((rule.name for rule in task.rules), each, strict=True))
    rho = _overall(task.rules, by_name, like)
    safe = ONNX.where(broken, -math.inf, _overall(task.compiled.safety, by_name, like))
    return Verdicts(rho, safe, each, _cost(task, states, controls, rho), states)


def _overall(rules: Sequence[CompiledRequirement], each: Columns, like: Value) -> Value:
    """The weighed minimum, (1, batch); +inf without rules."""
    if not rules:
        return like.sheet.constant([[math.inf]]).spread(1, BATCH, like=like)
    weighed = [
        each[rule.name] if rule.weight == rule.scale else each[rule.name] * (rule.weight / rule.scale)
        for rule in rules
    ]
    least: Value = ONNX.join(weighed, "min")
    return least


def _broken(task: Task, plans: Value, states: Columns, margins: Sequence[Value]) -> Value:
    """Where a plan holds what is no finite number, or something that follows from it is NaN, (1, batch)."""
    nothing = _reduced("ReduceSum", plans * 0.0, (1, 2)).reshaped(1, BATCH)
    moving = [states[name] for name in task.system.exact_step.next]
    like = next(iter(states.values()))
    wide = [column.spread(column.shape[0], BATCH, like=like) for column in (*moving, *margins)]
    together = joined([nothing, *wide])
    lost = together.apply("IsNaN", kind="bool").cast("float32")
    return _reduced("ReduceMax", lost, (0,)).apply("Greater", 0.5, kind="bool")


def _reduced(op: str, x: Value, axes: tuple[int, ...]) -> Value:
    """A reduction that keeps its axes."""
    shape = tuple(1 if place in axes else length for place, length in enumerate(x.shape))
    (out,) = x.sheet.emit(op, (x, x.sheet.constant(axes, "int64")), [shape], x.kind, {"keepdims": 1})
    return out


def rank(found: Verdicts) -> Value:
    """`stlc.controller.problem.task.rank`, (1, batch)."""
    rho, cost = found.rho, found.cost
    unknown = cost.apply("IsNaN", kind="bool")
    cheap = ONNX.where(unknown, 0.0, 1.0 / (1.0 + ONNX.clamp(ONNX.where(unknown, 0.0, cost), 0.0, None)))
    size = rho.apply("Abs")
    poor = ONNX.where(ONNX.gt(math.inf, size), rho / (1.0 + size), -1.0) + cheap * TIE
    poor = ONNX.where(ONNX.ge(found.safe, -TOLERANCE), poor, poor - 2.0)
    good = ONNX.both(ONNX.ge(rho, -TOLERANCE), unknown.apply("Not"))
    score: Value = ONNX.where(good, 1.0 + cheap, poor)
    return score


# ------------------------------------------------------------------------ cost


def _cost(task: Task, states: Columns, controls: Columns, rho: Value) -> Value:
    """The performance terms as if every plan were satisfying, (1, batch)."""
    system, rows = task.system, task.horizon
    moments = rho.sheet.constant([[float(k)] for k in range(rows + 1)])
    env = {"k": moments, "t": moments * task.dt, "sat": ONNX.full((1, 1), 1.0, rho), "rho": rho}
    env |= {name + START: column[:1] for name, column in states.items()}
    over_states, over_controls = system.objective
    before = {name: column[:rows] for name, column in (env | dict(states)).items()}
    parts = [rho.sheet.constant([[0.0]])]
    if over_states is not None:
        parts.append(_mean(over_states, env | dict(states), rows + 1))
    if over_controls is not None:
        parts.append(_mean(over_controls, before | dict(controls), rows))
    if task.promises.items:
        parts.append(_short(task, states) * KEPT)
    if task.compiled.guidance_cost is not None:
        parts.append(_mean(task.compiled.guidance_cost, states, rows + 1) * PULL)
    if task.compiled.timers:
        parts.append(_lacking(task, rho) * SHORT)
    return reduce(ONNX.add, parts).spread(1, BATCH, like=rho)


def _mean(number: ir.Num, env: Columns, rows: int) -> Value:
    value = assigned({"cost": number}, env)["cost"]
    return _reduced("ReduceMean", value.spread(rows, value.shape[1]), (0,))


def _lacking(task: Task, spared: Value) -> Value:
    """What something lacks of gamma."""
    gamma = task.system.decl.objective.gamma
    lack: Value = ONNX.clamp(gamma - spared, 0.0, gamma)
    return lack


def _short(task: Task, states: Columns) -> Value:
    """`Promises.short`."""
    promises = task.promises
    clock = states[promises.clock]
    margins = written([each.body for each in promises.items], states, count=len(clock))
    lacks = []
    for promise, margin in zip(promises.items, margins, strict=True):
        counts = ONNX.both(ONNX.ge(clock, promise.first), ONNX.ge(promise.last, clock))
        best = ONNX.amax(ONNX.where(counts, margin, -math.inf))
        still_open = ONNX.gt(HELD, ONNX.abs(states[promise.status][:1]))
        lacks.append(ONNX.where(still_open, _lacking(task, best), 0.0))
    return reduce(ONNX.add, lacks)


def deepened(task: Task, states: Columns) -> Value:
    """`Promises.deepened`, (1, batch) booleans; there is at least one promise."""
    soon = {name: column[:2] for name, column in states.items()}
    gamma, found = task.system.decl.objective.gamma, []
    for margin in written([each.body for each in task.promises.items], soon, count=2):
        now, next_ = margin.spread(2, margin.shape[1])[:1], margin.spread(2, margin.shape[1])[1:]
        held = ONNX.both(ONNX.ge(now, 0.0), ONNX.gt(gamma, now))
        found.append(ONNX.both(held, ONNX.gt(next_, now)))
    return reduce(ONNX.either, found)


# ------------------------------------------------------------------------ prefixes


def falls(task: Task, start: Columns, plans: Value) -> Value:
    """`stlc.controller.guard.safe_prefix.prefix_robustness`, (T + 1, batch).

    Every prefix is a trajectory of its own, as there: columns are (T + 1, prefixes * batch).
    """
    rows = task.horizon + 1
    states = rolled(task.system.exact_step, start, inputs_of(plans, task))
    like = next(iter(start.values()))
    prefixes = [[[1.0 if k > end else -1.0] for end in range(rows)] for k in range(rows)]
    beyond = like.sheet.constant(prefixes).spread(rows, rows, BATCH, like=like)
    columns = {
        name: column.spread(rows, BATCH, like=like)
        .reshaped(rows, 1, BATCH)
        .spread(rows, rows, BATCH, like=like)
        for name, column in states.items()
    }
    columns[BEYOND] = beyond
    flat = {name: column.reshaped(rows, BATCH) for name, column in columns.items()}
    formulas = [open_ended(anchored(rule.formula)) for rule in task.compiled.safety]
    margins = written(formulas, flat)
    least = ONNX.join([margin.spread(1, BATCH, like=flat[BEYOND]) for margin in margins], "min")
    found: Value = least.reshaped(rows, BATCH)
    return found
