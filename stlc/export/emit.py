"""A controller as one C header: policy, model, monitor and the paper's backup policy."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, assert_never

from stlc.compile.backends.c.emit import CHECK, HEAD, forward_blocks, passes, state_index
from stlc.compile.backends.c.numbers import literal
from stlc.compile.backends.c.parts import declared, in_parts
from stlc.compile.backends.c.plan import plan_of
from stlc.controller.guard.candidates import grid_of
from stlc.controller.guard.safe_prefix import BEYOND, anchored, open_ended
from stlc.controller.problem.native import motion_of
from stlc.dynamics.model.controls import raw_width
from stlc.escape import c_comment, c_string
from stlc.export import c_numbers, c_weights
from stlc.runtime.prefixes import generators

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.compile.augment.timers import Timer
    from stlc.compile.backends.c.emit import Motion
    from stlc.compile.backends.c.plan import Plan
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.controller.policies.policy import PlanNetwork
    from stlc.controller.problem.task import Task
    from stlc.signature import Column


def header(task: Task, network: PlanNetwork) -> str:
    """The text of `stlc_controller.h`, which includes `stlc_weights.h`.

    Raises:
        Untranslatable: the task holds something that has no C form.
    """
    motion = motion_of(task.system)
    judged = plan_of([rule.formula for rule in task.rules], task.horizon + 1)
    falling = plan_of([open_ended(anchored(rule.formula)) for rule in task.compiled.safety], task.horizon + 1)
    parts = _numbers(task, network) | {
        "HEAD": HEAD,
        "PASSES": "\n".join([*passes(motion, judged), *_falling(motion, falling)]),
        "ROOM": max(judged.size, falling.size, 1),
    }
    return _template("controller.h.txt").substitute({name: str(value) for name, value in parts.items()})


def main_of(task: Task) -> str:
    """An example program: states from standard input, decisions to standard output."""
    return _template("main.c.txt").substitute({"SYSTEM": c_comment(task.system.name)})


def makefile() -> str:
    """How the example is built."""
    return _template("Makefile.txt").substitute()


def _template(name: str) -> Template:
    return _Template(files("stlc.export").joinpath("templates", name).read_text(encoding="utf-8"))


class _Template(Template):
    delimiter = "@"


def _numbers(task: Task, network: PlanNetwork) -> dict[str, object]:
    """Sizes, constants and straight-line code."""
    grid, mirror = grid_of(task), network.mirror
    most = max((grid.count(length) for length in grid.lengths), default=0)
    controls = task.system.controls
    return {
        "NAME": c_comment(task.system.name),
        "SPEC": c_comment(task.compiled.name),
        "STATES": len(task.names),
        **_added(task),
        "NAMES": ", ".join(map(c_string, task.names)),
        "INPUTS": ", ".join(c_string(control.name) for control in controls),
        "CONTROLS": len(controls),
        "STEPS": task.horizon,
        "DT": literal(task.dt),
        "RULES": len(task.rules),
        "RULE_NAMES": ", ".join(c_string(rule.name) for rule in task.rules),
        "SAFETY": len(task.compiled.safety),
        "PLANS": network.plans,
        "RAW": raw_width(controls),
        "OBSERVED": task.system.observed_count,
        "WIDEST": c_weights.widest(network),
        "CHOICES": most + 1,
        "LENGTHS": ", ".join(map(str, grid.lengths)) or "0",
        "LENGTH_COUNT": len(grid.lengths),
        "SAMPLES": grid.samples,
        "RANDOM": int(grid.sampling == "random"),
        "GENERATORS": _generators(len(controls) * max(grid.lengths, default=1)),
        "LEVEL_COUNTS": ", ".join(str(len(values)) for values in grid.values),
        "MOST_LEVELS": max(map(len, grid.values)),
        "LEVELS": ", ".join("{" + ", ".join(map(literal, values)) + "}" for values in grid.values),
        "REST": ", ".join(literal(min(max(0.0, each.low), each.high)) for each in controls),
        "MIRRORED": int(mirror is not None),
        "SIDE": 0 if mirror is None else mirror.side,
        "OBSERVE": _block(c_numbers.observed(task)),
        "IMAGE_STATE": "" if mirror is None else _block(c_numbers.image_of_state(mirror, task)),
        "IMAGE_ACTION": "" if mirror is None else _block(c_numbers.image_of_action(task)),
        "SQUASH": _block(c_numbers.squashed(task)),
        "FORWARD": _block(c_weights.forward(network)),
        "COMMAND": _block(c_numbers.command(task)),
        "COST": _block(c_numbers.cost(task)),
        "OVERALL": _block(_overall(task.rules, task.rules)),
        "SAFE": _block(_overall(task.compiled.safety, task.rules)),
    }


def _in_its_unit(text: str, column: Column) -> str:
    return f"{text} [{column.unit.text}]" if column.unit.text else text


def _added(task: Task) -> dict[str, object]:
    """What the specification adds to states: what it holds, how it begins and how it goes on."""
    system, first = task.system, len(task.system.decl.signature.names)
    measured = [_in_its_unit("measured", column) for column in system.decl.signature.columns]
    tables = [
        (_in_its_unit("parameter, the caller's", each.column), each.column) for each in system.parameters
    ]
    tables += [(_holds(timer), timer.column) for timer in system.timers]
    place = first + len(system.parameters)
    listed = [f"     {c_comment(column.name)}: {c_comment(text)}" for text, column in tables]
    return {
        "MEASURED": first,
        "PARAMETERS": len(system.parameters),
        "TIMERS": len(system.timers),
        "ADDED": "\n".join(listed) or "     nothing",
        "ABOUT": ", ".join(map(c_string, [*measured, *(text for text, _ in tables)])),
        "BEGIN": _block(
            [f"x[{place + i}] = {literal(each.initial)};" for i, each in enumerate(system.timers)]
        ),
        "ADVANCE": _block(c_numbers.later(task)),
    }


def _holds(timer: Timer) -> str:
    """What a state holds that the specification adds, in words."""
    match timer.kind:
        case "status":
            about = timer.about.removeprefix("open | true | false").strip()
            return f"status, 0 open, 1 true, -1 false: {about}"
        case "latch":
            return f"1 or 0: {timer.about}"
        case "clock" | "timer":
            return timer.about
        case _:
            assert_never(timer.kind)


def _generators(dims: int) -> str:
    return ", ".join(f"{each}u" for each in generators(dims))


def _block(lines: Sequence[str]) -> str:
    return "\n".join(f"  {line}" for line in lines)


def _overall(rules: Sequence[CompiledRequirement], among: Sequence[CompiledRequirement]) -> list[str]:
    """Statements that lower `least` to the weighed robustness of some requirements."""
    names = [rule.name for rule in among]
    return [
        f"least = MIN(least, each[{names.index(rule.name)}] * {literal(rule.weight / rule.scale)});"
        for rule in rules
    ]


def _falling(motion: Motion, plan: Plan) -> list[str]:
    """`fall`: the least robustness of phi_safe on a prefix; row STATES is positive beyond its end."""
    blocks = forward_blocks(plan, state_index(motion) | {BEYOND: len(motion.states)})
    return in_parts(replace(CHECK, name="fall"), blocks, declared(plan))
