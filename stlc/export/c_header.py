"""Export of a controller as one C header (C99, C++11): policy, model, monitor and guard.

The guard is that of Meng and Fan (2023). The code is that of the native kernel (the compiled code that
evaluates plans in stlc), whose functions have short names such as `rollout` and `check`. These could collide
with names in the program that includes the header, so every name gets a prefix.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from string import Template
from typing import assert_never

import torch
from torch import Tensor

from stlc.compile.augment.timers import Timer
from stlc.compile.backends.c.emit import CHECK, HEAD, forward_blocks, passes, state_index
from stlc.compile.backends.c.numbers import NumberWriter, literal
from stlc.compile.backends.c.parts import declared, in_parts
from stlc.compile.backends.c.plan import plan_of
from stlc.compile.backends.numbers import Leaf
from stlc.compile.ir import nodes as ir
from stlc.compile.pipeline import CompiledRequirement
from stlc.controller.guard.candidates import grid_of
from stlc.controller.guard.safe_prefix import BEYOND, anchored, open_ended
from stlc.controller.policies.policy import ClosedLoopActor, PlanProposer
from stlc.controller.problem.native import motion_of
from stlc.controller.problem.task import Task
from stlc.dynamics.declaration.learning import START
from stlc.dynamics.declaration.schema.names import ControlDecl
from stlc.dynamics.model.controls import SQUASHES, raw_width
from stlc.dynamics.model.cost import REDUCED, CostTerm
from stlc.escape import c_comment, c_string
from stlc.export.description import control_images, observation, state_images
from stlc.runtime.decision import TIE
from stlc.runtime.prefixes import generators
from stlc.signature import Column

# ------------------------------------------------------------------------------------ names of its own


PREFIX = "stlc_"
OWN = ("stlc_", "STLC_")

_DECLARED = (
    re.compile(r"^(?:APART )?static (?:inline )?(?:const )?\w+ \**(\w+)\(", re.M),  # functions
    re.compile(r"^typedef \w+ (\w+)(?:\[\w+\])*;", re.M),
    re.compile(r"^static const [\w *]*?(\w+)(?:\[\w*\])+ = ", re.M),  # arrays
)
_DEFINED = re.compile(r"^#define (\w+)", re.M)
_TOKEN = re.compile(
    r"""/\*.*?\*/ | "(?:\\.|[^"\\])*" | \#include[^\n]*            # left as they are
    | (?P<hex>0x[0-9a-f]+(?:\.[0-9a-f]*)?p[+-]?\d+)
    | (?P<word>(?<![\w.])(?<!->)[A-Za-z_]\w*)""",
    re.S | re.X,
)
_OPENING = """
#ifdef __cplusplus
#define STLC_RESTRICT __restrict
#else
#define STLC_RESTRICT restrict
#endif
#if defined(__GNUC__) /* what the generated passes do not need of what they are given */
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#endif
"""
_CLOSING = """
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
"""


def public(texts: Mapping[str, str], guard: str) -> dict[str, str]:
    """Return the texts of the header files as valid C99 and C++11, with every declared name prefixed.

    Args:
        texts: file name -> text; a name declared in one file is prefixed in all files.
        guard: macro of the include guard. A text with an include guard must end with its `#endif`.
    """
    names: dict[str, str] = {}
    for text in texts.values():
        found = [name for pattern in _DECLARED for name in pattern.findall(text)]
        macros = _DEFINED.findall(text)
        names |= {name: PREFIX + name for name in found if not name.startswith(OWN)}
        names |= {name: PREFIX.upper() + name for name in macros if not name.startswith(OWN)}
    names |= {"restrict": "STLC_RESTRICT", guard: guard}
    written = {file: _TOKEN.sub(lambda token: _written(token, names), text) for file, text in texts.items()}
    opening = f"#define {guard}\n"
    for file, text in written.items():
        if opening in text:
            body, end = text.replace(opening, opening + _OPENING, 1).rsplit("#endif", 1)
            written[file] = f"{body.rstrip()}\n{_CLOSING}\n#endif{end}"
    return written


def _written(token: re.Match[str], names: Mapping[str, str]) -> str:
    if token["hex"]:
        return repr(float.fromhex(token["hex"]))  # C++ knows hexadecimal fractions from C++17 on
    return names.get(token["word"], token[0]) if token["word"] else token[0]


# --------------------------------------------------------------------------------------------- weights


def weights(network: PlanProposer) -> str:
    """Return the weights of a network as C arrays.

    The arrays are `centre` and `spread`, by which the inputs are normalised, and `weight_i` (in, out) and
    `bias_i` of each layer.
    """
    layers = network.layers
    lines = ["/* float32, row by row; generated */"]
    lines += [f"static const float centre[] = {{{_row(layers.centre)}}};"]
    lines += [f"static const float spread[] = {{{_row(layers.spread)}}};"]
    for number, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        outputs, inputs = weight.shape
        rows = ",\n".join(f"{{{_row(row)}}}" for row in weight.detach().t())
        lines.append(f"static const float weight_{number}[{inputs}][{outputs}] = {{\n{rows}}};")
        lines.append(f"static const float bias_{number}[{outputs}] = {{{_row(bias)}}};")
    return "\n".join(lines) + "\n"


def forward(network: PlanProposer) -> list[str]:
    """C statements of the network: from the observation `seen` (double) to the output `raw` (float).

    The layers use two C arrays in turn: layer 0 reads `h0` and writes `h1`, layer 1 reads `h1` and writes
    `h0`, and so on. The last layer writes `raw`.
    """
    layers = network.layers
    scaled = "((float)seen[i] - centre[i]) / spread[i]"
    if math.isfinite(layers.bound):
        bound = _float(layers.bound)
        scaled = f"MAX(MIN({scaled}, {bound}), -{bound})"
    lines = [f"for (int i = 0; i < {len(layers.centre)}; ++i) h0[i] = {scaled};"]
    for number, weight in enumerate(layers.weights):
        last = number == len(layers.weights) - 1
        source, target = f"h{number % 2}", "raw" if last else f"h{(number + 1) % 2}"
        sizes = f"{weight.shape[1]}, {weight.shape[0]}"
        function = 0 if last else 1 if layers.activation == "relu" else 2
        lines.append(
            f"layer({source}, {target}, &weight_{number}[0][0], bias_{number}, {sizes}, {function});"
        )
    return lines


def widest(network: PlanProposer) -> int:
    """Greatest number of inputs among the network's layers."""
    return max(weight.shape[1] for weight in network.layers.weights)


def _row(values: Tensor) -> str:
    return ", ".join(_float(value) for value in values.detach().to(torch.float32).tolist())


def _float(value: float) -> str:
    """C text of a float32, with enough digits that a compiler restores exactly this number."""
    text = f"{value:.9g}"
    return f"{text}f" if any(mark in text for mark in ".en") else f"{text}.0f"


# --------------------------------------------------------------------------------------------- numbers


def squashed(controls: Sequence[ControlDecl]) -> list[str]:
    """C statements that compute the controls `u` of one time step from outputs `raw` of the network.

    The outputs are mapped to the ranges of the controls, by `tanh` for instance.
    """
    lines, at = [], 0
    for i, each in enumerate(controls):
        middle, half = literal((each.low + each.high) / 2), literal((each.high - each.low) / 2)
        kind = SQUASHES[each.squash]
        unit = kind.c.format(*(f"raw[{at + k}]" for k in range(kind.outputs)))
        lines.append(f"u[{i}] = (float){middle} + {unit} * (float){half};")
        at += kind.outputs
    return lines


def command(task: Task) -> list[str]:
    """C statements for the actuator command `command`, from the state `x` and a plan's first control `u`."""
    names, given = task.system.control_names, task.system.decl.commands
    places = {name: f"x[{i}]" for i, name in enumerate(task.system.names)}
    places |= {name: f"u[{i}]" for i, name in enumerate(names)}
    return _assigned("command", [given.get(name, ir.Signal(name)) for name in names], places)


def _assigned(target: str, numbers: Sequence[ir.Num], places: Mapping[str, str]) -> list[str]:
    writer = NumberWriter(_columns(places))
    values = [writer.number(number) for number in numbers]
    return [*writer.lines, *(f"{target}[{i}] = {value};" for i, value in enumerate(values))]


def _places(array: str, names: Sequence[str]) -> dict[str, str]:
    return {name: f"{array}[{i}]" for i, name in enumerate(names)}


def _columns(places: Mapping[str, str]) -> Callable[[Leaf], str | None]:
    return lambda leaf: places[leaf.name] if isinstance(leaf, ir.Signal) else None


def cost(task: Task) -> list[str]:
    """C statements that add the cost of a plan to `cost`, given its states and its robustness `rho`.

    Raises:
        Untranslatable: the robustness of a goal cannot be computed from a single sample in C.
    """
    at = {name: f"x[{i}][k][j]" for i, name in enumerate(task.system.names)}
    at |= {name + START: f"x[{i}][0][j]" for i, name in enumerate(task.system.names)}
    at |= {"k": "(double)k", "t": f"(k * {literal(task.system.dt)})", "sat": "1.0", "rho": "rho"}
    at |= {name: f"u[{i}][k][j]" for i, name in enumerate(task.system.control_names)}
    samples = task.horizon + 1
    return [line for term in task.plan_cost.terms for line in _term(term, at, samples - term.controlled)]


def _term(term: CostTerm, at: Mapping[str, str], samples: int) -> list[str]:
    each = NumberWriter(_columns(at))
    number = each.number(term.number)
    first, join, reduced = "0.0", f"all += {number};", f"all / {samples}"
    if term.greatest:
        first, join, reduced = "-INFINITY", f"all = MAX(all, {number});", "all"
    result = NumberWriter(_columns({**at, REDUCED.name: reduced}))
    value = result.number(term.value)
    return [
        f"{{ double all = {first};",
        " ".join([f"for (int k = 0; k < {samples}; ++k) {{", *each.lines, join, "}"]),
        " ".join([*result.lines, f"cost += {value}; }}"]),
    ]


# ------------------------------------------------------------------------------------------ the header


def header(task: Task, network: PlanProposer) -> str:
    """Return the text of `stlc_controller.h`, which includes `stlc_weights.h`.

    Raises:
        Untranslatable: a part of the task cannot be expressed in C.
    """
    motion = motion_of(task.system)
    judged = plan_of([rule.formula for rule in task.rules], task.horizon + 1)
    falling = plan_of([open_ended(anchored(rule.formula)) for rule in task.compiled.safety], task.horizon + 1)
    numbers, checks = _numbers(task, network), passes(motion, judged)
    # `fall`: the safety requirements on the first steps of a trajectory; a signal with the index STATES is
    # positive at the later samples, which count as harmless
    blocks = forward_blocks(falling, state_index(motion) | {BEYOND: len(motion.states)})
    fall = in_parts(replace(CHECK, name="fall"), blocks, declared(falling))
    parts = numbers | {
        "HEAD": HEAD,
        "PASSES": "\n".join([*checks, *fall]),
        "DECISION": decision(),
        "ROOM": max(judged.size, falling.size, 1),
    }
    return _template("controller.h.txt").substitute({name: str(value) for name, value in parts.items()})


def decision() -> str:
    """Return the C functions that rank plans and choose among them: `stlc.runtime.decision` in C."""
    return _template("decision.c.txt").substitute(TIE=repr(TIE)).rstrip()


def main_of(task: Task) -> str:
    """Return the C source of an example program: it reads states and writes decisions."""
    return _template("main.c.txt").substitute({"SYSTEM": c_comment(task.system.decl.name)})


def makefile() -> str:
    """Return the text of the Makefile that builds the example program."""
    return _template("Makefile.txt").substitute()


def _template(name: str) -> Template:
    return _Template(files("stlc.export").joinpath("templates", name).read_text(encoding="utf-8"))


class _Template(Template):
    delimiter = "@"


def _numbers(task: Task, network: PlanProposer) -> dict[str, object]:
    """Values for the template of the header: placeholder -> a size, a constant or generated code."""
    grid = grid_of(task)
    most = max((grid.count(length) for length in grid.lengths), default=0)
    controls, names = task.system.decl.controls, task.system.control_names
    states, inputs = _places("x", task.system.names), _places("u", names)
    given = task.system.decl.commands
    commanded = [given.get(name, ir.Signal(name)) for name in names]
    return {
        "NAME": c_comment(task.system.decl.name),
        "SPEC": c_comment(task.compiled.name),
        "STATES": len(task.system.names),
        **_added(task),
        "NAMES": ", ".join(map(c_string, task.system.names)),
        "INPUTS": ", ".join(c_string(control.name) for control in controls),
        "CONTROLS": len(controls),
        "STEPS": task.horizon,
        "DT": literal(task.system.dt),
        "RULES": len(task.rules),
        "RULE_NAMES": ", ".join(c_string(rule.name) for rule in task.rules),
        "SAFETY": len(task.compiled.safety),
        "PLANS": network.plans,
        **_changes(network),
        "LOW": ", ".join(literal(each.low) for each in controls),
        "HIGH": ", ".join(literal(each.high) for each in controls),
        "RAW": raw_width(network.outputs),
        "OBSERVED": len(network.layers.centre),
        "WIDEST": widest(network),
        "CHOICES": most + 1,
        "LENGTHS": ", ".join(map(str, grid.lengths)) or "0",
        "LENGTH_COUNT": len(grid.lengths),
        "SAMPLES": grid.samples,
        "RANDOM": int(grid.sampling == "random"),
        "GENERATORS": ", ".join(map("{}u".format, generators(len(controls) * max(grid.lengths, default=1)))),
        "LEVEL_COUNTS": ", ".join(str(len(values)) for values in grid.values),
        "MOST_LEVELS": max(map(len, grid.values)),
        "LEVELS": ", ".join("{" + ", ".join(map(literal, values)) + "}" for values in grid.values),
        "REST": ", ".join(literal(min(max(0.0, each.low), each.high)) for each in controls),
        "OBSERVE": _block(_assigned("seen", observation(task), states)),
        "SQUASH": _block(squashed(network.outputs)),
        "PROPOSE": _proposing(task, network),
        "COMMAND": _block(_assigned("command", commanded, states | inputs)),
        "COST": _block(cost(task)),
        "OVERALL": _block(_overall(task.rules, task.rules)),
        "SAFE": _block(_overall(task.compiled.safety, task.rules)),
    }


def _proposing(task: Task, network: PlanProposer) -> str:
    """C function `propose`: the plans of the network, or the closed loop of an actor on the model."""
    parts: dict[str, object] = {"FORWARD": _block(forward(network))}
    if isinstance(network, ClosedLoopActor):
        return _template("propose_actor.c.txt").substitute(parts | {"STEP": _block(_step(task))}).rstrip()
    mirror = network.mirror
    states, inputs = _places("x", task.system.names), _places("u", task.system.control_names)
    moved, reflected = state_images(task), list(control_images(task).values())
    images = [moved.get(name, ir.Signal(name)) for name in task.system.names]
    parts |= {
        "MIRRORED": int(mirror is not None),
        "SIDE": 0 if mirror is None else mirror.side,
        "ELAPSED": "0" if network.clock is None else f"(int)(x[STLC_STATES - {-network.clock}] + 0.5)",
        "IMAGE_STATE": "" if mirror is None else _block(_assigned("image", images, states)),
        "IMAGE_ACTION": "" if mirror is None else _block(_assigned("image", reflected, inputs)),
    }
    return _template("propose_plans.c.txt").substitute(parts).rstrip()


def _step(task: Task) -> list[str]:
    """C statements of one exact step of the model: from states `x` and controls `u` to states `after`."""
    system, step = task.system, task.system.exact_step
    writer = NumberWriter(_columns(_places("x", system.names) | _places("u", system.control_names)))
    for name, number in step.lets:
        writer.bound[name] = writer.number(number)
    moved = {name: writer.number(number) for name, number in step.next.items()}
    places = {name: i for i, name in enumerate(system.names)}
    return [*writer.lines, *(f"after[{places[name]}] = {value};" for name, value in moved.items())]


def _changes(network: PlanProposer) -> dict[str, object]:
    """Texts for the header about the changed copies of plans: placeholder -> number or C text.

    If a plan violates the specification, the policy also tries copies of it in which one control is changed.
    The network stores these changes. The C arrays hold one row per change; without changes they hold one row
    of zeros, as C has no empty arrays.
    """
    changes = (
        network.changes if len(network.changes) else network.changes.new_zeros(1, *network.changes.shape[1:])
    )
    changed = changes.abs().amax(1).argmax(1)
    rows = changes.gather(2, changed[:, None, None].expand(-1, changes.shape[1], 1))[:, :, 0]
    return {
        "CHANGES": len(network.changes),
        "CHANGED": ", ".join(map(str, changed.tolist())),
        "CHANGE": ",\n".join("{" + ", ".join(map(literal, row)) + "}" for row in rows.tolist()),
    }


def _in_its_unit(text: str, column: Column) -> str:
    return f"{text} [{column.unit.text}]" if column.unit.text else text


def _added(task: Task) -> dict[str, object]:
    """Texts for the header about the states that the specification adds: placeholder -> number or C text.

    A placeholder is a name in the template of the header. The texts contain the meaning of these states,
    their initial values and their updates.
    """
    system, first = task.system, len(task.system.decl.signature.names)
    measured = [_in_its_unit("measured", column) for column in system.decl.signature.columns]
    tables = [
        (_in_its_unit("parameter, the caller's", each.column), each.column) for each in system.parameters
    ]
    tables += [(_description(timer), timer.column) for timer in system.timers]
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
        "ADVANCE": _block(
            _assigned("later", [timer.update for timer in system.timers], _places("x", task.system.names))
        ),
    }


def _description(timer: Timer) -> str:
    """Description, for the header, of a state that the specification adds."""
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


def _block(lines: Sequence[str]) -> str:
    return "\n".join(f"  {line}" for line in lines)


def _overall(rules: Sequence[CompiledRequirement], among: Sequence[CompiledRequirement]) -> list[str]:
    """C statements that compute the least weighted robustness of the requirements `rules`.

    The result is left in the C variable `least`, which must be initialised before. Entry i of the C array
    `each` is the robustness of the requirement `among[i]`; `among` contains `rules`.
    """
    names = [rule.name for rule in among]
    return [
        f"least = MIN(least, weighed(each[{names.index(rule.name)}], {literal(rule.factor)}));"
        for rule in rules
    ]
