"""The small functions of a controller as C: what is observed, mirrored and paid for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING

from stlc.compile.backends.c.numbers import Leaf, NumberWriter, Untranslatable, literal
from stlc.compile.ir import nodes as ir
from stlc.controller.problem.task import KEPT, PULL, SHORT, Task
from stlc.dynamics.declaration.learning import START
from stlc.dynamics.model.step import commands

if TYPE_CHECKING:
    from stlc.controller.problem.pending_goals import PendingGoal
    from stlc.dynamics.model.mirror import Mirror


def observed(task: Task) -> list[str]:
    """Statements that fill `seen` from the state `x`."""
    system = task.system
    numbers = [*system.decl.policy.observe, *(ir.Signal(column.name) for column in system.added)]
    if not system.decl.policy.observe:
        numbers = [ir.Signal(name) for name in system.names]
    return _assigned("seen", numbers, {name: f"x[{i}]" for i, name in enumerate(system.names)})


def later(task: Task) -> list[str]:
    """Statements that fill `later` with what clocks, statuses and timers are a step after the state `x`."""
    numbers = [timer.update for timer in task.system.timers]
    return _assigned("later", numbers, {name: f"x[{i}]" for i, name in enumerate(task.names)})


def image_of_state(mirror: Mirror, task: Task) -> list[str]:
    """Statements that fill `image` from the state `x`."""
    names = task.names
    moved = {each.name: each.value for each in task.system.decl.policy.mirror}
    numbers = [moved.get(name, ir.Signal(name)) for name in names]
    assert mirror.side < len(names)
    return _assigned("image", numbers, {name: f"x[{i}]" for i, name in enumerate(names)})


def image_of_action(task: Task) -> list[str]:
    """Statements that fill `image` from the controls `u`; angles stay within a turn of their range."""
    controls = task.system.controls
    moved = {each.name: each.value for each in task.system.decl.policy.mirror}
    numbers = [moved.get(each.name, ir.Signal(each.name)) for each in controls]
    lines = _assigned("image", numbers, {each.name: f"u[{i}]" for i, each in enumerate(controls)})
    for i, each in enumerate(controls):
        if each.squash == "angle":
            low = literal(each.low)
            lines.append(f"image[{i}] = floored_mod(image[{i}] - {low}, 2.0 * PI) + {low};")
    return lines


def squashed(task: Task) -> list[str]:
    """Statements that fill `u` from what the network gives for one step, `raw`."""
    lines, at = [], 0
    for i, each in enumerate(task.system.controls):
        middle, half = literal((each.low + each.high) / 2), literal((each.high - each.low) / 2)
        match each.squash:
            case "tanh":
                unit, width = f"tanhf(raw[{at}])", 1
            case "clip":
                unit, width = f"MIN(MAX(raw[{at}], -1.0f), 1.0f)", 1
            case "angle":
                unit, width = f"atan2f(raw[{at + 1}], raw[{at}] + 1e-6f) / (float)PI", 2
        lines.append(f"u[{i}] = (float){middle} + {unit} * (float){half};")
        at += width
    return lines


def command(task: Task) -> list[str]:
    """Statements that fill `command` from the state `x` and the first action `u` of a plan."""
    names, given = task.system.control_names, commands(task.system.decl)
    places = {name: f"x[{i}]" for i, name in enumerate(task.names)}
    places |= {name: f"u[{i}]" for i, name in enumerate(names)}
    return _assigned("command", [given.get(name, ir.Signal(name)) for name in names], places)


def _assigned(target: str, numbers: Sequence[ir.Num], places: Mapping[str, str]) -> list[str]:
    writer = NumberWriter(_columns(places))
    values = [writer.number(number) for number in numbers]
    return [*writer.lines, *(f"{target}[{i}] = {value};" for i, value in enumerate(values))]


def _columns(places: Mapping[str, str]) -> Callable[[Leaf], str | None]:
    return lambda leaf: places[leaf.name] if isinstance(leaf, ir.Signal) else None


# ------------------------------------------------------------------------ cost


def cost(task: Task) -> list[str]:
    """Statements that add what a plan costs to `cost`, of lane `j` with robustness `rho`."""
    at = {name: f"x[{i}][k][j]" for i, name in enumerate(task.names)}
    at |= {name + START: f"x[{i}][0][j]" for i, name in enumerate(task.names)}
    at |= {"k": "(double)k", "t": f"(k * {literal(task.dt)})", "sat": "1.0", "rho": "rho"}
    inputs = {name: f"u[{i}][k][j]" for i, name in enumerate(task.system.control_names)}
    states, controlled = task.system.objective
    lines: list[str] = []
    if states is not None:
        lines += _mean(states, at, task.horizon + 1)
    if controlled is not None:
        lines += _mean(controlled, at | inputs, task.horizon)
    for promise in task.promises.items:
        lines += _promise(promise, task, at)
    if task.compiled.guidance_cost is not None:
        lines += _mean(ir.Op("mul", (ir.Const(PULL), task.compiled.guidance_cost)), at, task.horizon + 1)
    if task.compiled.timers:
        gamma = literal(task.system.decl.objective.gamma)
        lines.append(f"cost += {literal(SHORT)} * MIN(MAX({gamma} - rho, 0.0), {gamma});")
    return lines


def _mean(number: ir.Num, places: Mapping[str, str], count: int) -> list[str]:
    writer = NumberWriter(_columns(places))
    value = writer.number(number)
    body = " ".join([*writer.lines, f"sum += {value};"])
    return [f"{{ double sum = 0.0; for (int k = 0; k < {count}; ++k) {{ {body} }} cost += sum / {count}; }}"]


def _promise(promise: PendingGoal, task: Task, places: Mapping[str, str]) -> list[str]:
    """What is lacked of gamma where a promise is open."""
    writer = NumberWriter(_columns(places))
    margin = writer.number(margin_of(promise.body))
    clock = places[task.promises.clock]
    status = places[promise.status].replace("[k]", "[0]")
    gamma = literal(task.system.decl.objective.gamma)
    counts = f"{clock} >= {literal(promise.first)} && {clock} <= {literal(promise.last)}"
    body = " ".join([*writer.lines, f"if ({counts}) top = MAX(top, {margin});"])
    return [
        f"if (fabs({status}) < 0.5) {{ double top = -INFINITY;",
        f"for (int k = 0; k <= {task.horizon}; ++k) {{ {body} }}",
        f"cost += {literal(KEPT)} * MIN(MAX({gamma} - top, 0.0), {gamma}); }}",
    ]


def margin_of(formula: ir.Formula) -> ir.Num:
    """The exact robustness of a state formula as a number. Raises Untranslatable for any other formula."""
    match formula:
        case ir.Predicate(num, sign, guard=False):
            return num if sign > 0 else ir.Op("neg", (num,))
        case ir.BoolOp(op, items):
            pick = "min" if op == "and" else "max"
            return reduce(lambda a, b: ir.Op(pick, (a, b)), map(margin_of, items))
        case ir.Truth(value):
            return ir.Const(float("inf") if value else float("-inf"))
        case _:
            raise Untranslatable(type(formula).__name__)
