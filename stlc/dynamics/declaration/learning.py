"""Sections `objective`, `policy` and `train`: loss, network, and training of a policy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from stlc.compile.frontend.arithmetic import absolute
from stlc.compile.frontend.scope import Entry, Known
from stlc.compile.frontend.values import Number
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.motion import Assign, component_texts, state_assigns
from stlc.dynamics.declaration.schema.expressions import SECOND, written
from stlc.dynamics.declaration.schema.names import Context, ControlDecl, each_number
from stlc.dynamics.declaration.schema.record import (
    EXPRESSION,
    NAME,
    OF,
    VECTOR,
    Kind,
    by_name,
    integer,
    items_of,
    json_schema,
    key,
    mapping_of,
    number,
    read,
    reads,
    word,
)
from stlc.dynamics.declaration.schema.yaml_nodes import Mapping as MappingNode
from stlc.dynamics.declaration.schema.yaml_nodes import Node, Scalar
from stlc.registry import METHODS
from stlc.signature import Column
from stlc.source import Span
from stlc.units import Unit

START = "_start"
"""Suffix of a state's name for its value at the start of the plan, in performance terms."""
OUTCOME = {
    "sat": "1 where the trajectory satisfies the specification",
    "rho": "robustness of the trajectory",
    "k": "number of the step",
}


# ------------------------------------------------------------------------------- objective


@reads(EXPRESSION)
def _absolute(cx: Context, node: Node, label: str) -> ir.Num | None:
    """Read a number and convert it to SI units; a temperature in degC becomes kelvin, offset included.

    Returns None if the number is invalid. `label` names the number in messages.
    """
    value = cx.here.number(node, label)
    return None if value is None else absolute(value).num


def _term_label(found: Mapping[str, Node]) -> str:
    """Name of a performance term in messages; its expression if it has no name."""
    name = found.get("name")
    shown = name.text if isinstance(name, Scalar) and not name.is_null else written(found.get("expr"))
    return f"the term `{shown}`"


@dataclass(frozen=True, slots=True)
class Term:
    """A performance term of the objective: `weight` times the mean of `value` over time and batch."""

    name: str = key(NAME, "for tables; the expression unless given", "", label=OF)
    weight: float = key(number(), "factor of the mean over a plan", 1.0)
    value: ir.Num = key(_absolute, "the cost", name="expr", label=_term_label, required=True)


@reads(items_of(json_schema(Term)), Term)
def term_list(cx: Context, node: Node | None, label: str) -> tuple[Term, ...]:
    """Read the performance terms of the objective; `label` names the list in messages.

    A term may read the outcome of a plan (`sat`: satisfied, `rho`: robustness), the step `k`, the time `t` in
    seconds, and `x_start`, the value at the start of the plan, for each state `x`.
    """
    known = cx.names.entries
    entries: dict[str, Entry] = {
        name: Known(Number(ir.Signal(name), flexible=True), about) for name, about in OUTCOME.items()
    }
    entries["t"] = Known(Number(ir.Signal("t"), SECOND), "seconds since the start of the plan")
    for state in cx.names.states:
        if isinstance(entry := known.get(state), Known):
            about = "its value at the start of the plan"
            entries[state + START] = each_number(replace(entry, about=about, span=None), _at_start)
    plain = cx.plain
    here = plain.here.extended({name: entry for name, entry in entries.items() if name not in known})
    terms = []
    for item in cx.reader.items(node, label):
        term = read(Term, replace(plain, here=here), item, "a term")
        if term.value is not None:
            expr = item.get("expr") if isinstance(item, MappingNode) else None
            terms.append(replace(term, name=term.name or written(expr)))
    return tuple(terms)


def _at_start(number: Number) -> Number:
    """Replace each state `x` in a number by the column `x_start`, its value at the start of the plan."""
    table = {name: ir.Signal(name + START) for name in number.num.columns}
    return replace(number, num=number.num.substitute(table))


@dataclass(frozen=True, slots=True)
class ObjectiveDecl:
    """The section `objective`: training loss (Meng and Fan 2023, Eq. 8-10).

    The loss is a hinge on the robustness plus weighted performance terms.
    """

    gamma: float = key(number(), "robustness at which the hinge ends", 0.5)
    smoothing: float = key(number(1e-9), "scale of the smooth robustness", 500.0)
    stl_weight: float = key(number(), "weight of the hinge", 1.0, name="lambda")
    terms: tuple[Term, ...] = key(term_list, "performance terms", ())


# ------------------------------------------------------------------------------------ policy


@dataclass(frozen=True, slots=True)
class Feedback:
    """Linear feedback law: actuators get clip(u0 + v + clip(K (x0 - x), -a, a), low, high).

    `v` is the planned control; all values are in the units of the columns.

    Attributes:
        gain: K, one row per control with one entry per state.
        state: x0, one entry per state.
        control: u0, one entry per control.
        low: lower ends of the actuators' ranges.
        high: upper ends of the actuators' ranges.
        authority: a, the largest contribution of the feedback, one entry per control.
    """

    gain: tuple[tuple[float, ...], ...]
    state: tuple[float, ...]
    control: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    authority: tuple[float, ...]


def _units(columns: Iterable[Column | ControlDecl]) -> dict[str, Unit]:
    """Units of states or controls, by column name."""
    return {each.name: each.unit for each in columns}


@reads(mapping_of(EXPRESSION))
def _around(cx: Context, node: Node, label: str) -> dict[str, float]:
    known = _units((*cx.names.columns, *cx.names.controls))
    return by_name(cx, node, label, known, lambda n, name, unit: cx.here.constant(n, f"`{name}`", unit))


@reads(mapping_of({"type": "number", "minimum": 0}))
def _weights(cx: Context, node: Node, label: str) -> dict[str, float]:
    known = _units((*cx.names.columns, *cx.names.controls))
    return by_name(cx, node, label, known, lambda n, name, _: cx.reader.number(n, f"the weight of `{name}`"))


@reads(mapping_of(mapping_of(EXPRESSION)))
def _gain(cx: Context, node: Node, label: str) -> dict[str, dict[str, float]]:
    states = _units(cx.names.columns)

    def row(node: Node, control: str, of: Unit) -> dict[str, float]:
        def entry(node: Node, state: str, unit: Unit) -> float | None:
            return cx.here.constant(node, f"the gain of `{state}`", of / unit)

        return by_name(cx, node, f"{label} of {control}", states, entry)

    return by_name(cx, node, label, _units(cx.names.controls), row)


@dataclass(frozen=True, slots=True)
class FeedbackDecl:
    """The entry `feedback` of the section `policy`: settings from which the feedback gain is computed.

    The computation is in `stlc.dynamics.model.feedback`.
    """

    around: Mapping[str, float] = key(_around, "point of operation: states and controls", {})
    weights: Mapping[str, float] = key(_weights, "weights of the regulator's cost, by state or control", {})
    gain: Mapping[str, Mapping[str, float]] = key(
        _gain, "the gain, by control and state, in place of the regulator's", {}
    )
    authority: float = key(number(), "largest share of half an actuator's range that the feedback adds", 1.0)


@reads({"anyOf": [{"enum": ["lqr"]}, json_schema(FeedbackDecl)]}, FeedbackDecl)
def _feedback(cx: Context, node: Node, label: str) -> dict[str, Any]:
    """Read the entry `feedback`: the word `lqr`, or a mapping of its settings.

    Returns the fields `feedback` and `feedback_span` of `PolicyDecl`. `label` names the entry in messages.
    """
    request = None
    if not isinstance(node, Scalar):
        request = read(FeedbackDecl, cx, node, label)
    elif node.text == "lqr":
        request = FeedbackDecl()
    elif not node.is_null:
        cx.reader.wrong(node, label, "`lqr`, or a mapping", "feedback: {weights: {angle: 10}}")
    return {"feedback": request, "feedback_span": node.span}


@reads(items_of(VECTOR))
def _observed(cx: Context, node: Node, label: str) -> dict[str, Any]:
    seen = [each for item in cx.reader.items(node, label) for each in _seen(item, cx)]
    return {"observe": tuple(num for num, _ in seen), "observe_text": tuple(text for _, text in seen)}


def _seen(node: Node, cx: Context) -> tuple[tuple[ir.Num, str], ...]:
    """Read one item of `observe`, the list of inputs of the policy network.

    An item is a number, a formula (observed as 0 or 1), or a vector. Returns a pair (expression, source text)
    for each component; the tuple is empty if the item is invalid.
    """
    expr = cx.here.parse(node, "an observation")
    if expr is not None and expr.is_formula:
        value = cx.here.truth(node, "an observation")
        return () if value is None else ((value, written(node)),)
    numbers = None if expr is None else cx.here.numbers(node, "an observation")
    if numbers is None:
        return ()
    texts = (written(node),) if len(numbers) == 1 else component_texts(node, len(numbers))
    return tuple(zip((number.num for number in numbers), texts, strict=True))


@reads(mapping_of(VECTOR))
def _mirror(cx: Context, node: Node, label: str) -> dict[str, Any]:
    """Read the entry `mirror`: the states and controls that a mirror symmetry changes, and their images.

    The image of a state or control is an expression. Returns the fields `mirror` and `mirror_span` of
    `PolicyDecl`. Before training, `stlc.controller.training.diagnose.check_mirror` checks that the dynamics
    are symmetric.
    """
    found: list[Assign] = []
    entries = cx.reader.entries(node, label)
    controls = {each.name: each for each in cx.names.controls}
    for entry in entries:
        control = controls.get(entry.key.text)
        if control is None:
            found.extend(state_assigns(entry, label, cx))
        elif (value := cx.here.stored(entry.value, f"`{control.name}`", control.unit)) is not None:
            found.append(Assign(control.name, value, written(entry.value)))
    if found and not any(column.name == found[0].name for column in cx.names.columns):
        message = f"`mirror` begins with the control `{found[0].name}`"
        advice = "write a state first: it tells a state from its mirror image"
        cx.reader.report("S103", message, entries[0].key.span, advice)
    return {"mirror": tuple(found), "mirror_span": node.span}


def _integers(cx: Context, node: Node, label: str) -> tuple[int, ...] | None:
    single = isinstance(node, Scalar) and node.integer is not None
    items = (node,) if single else cx.reader.items(node, label)
    values = [cx.reader.integer(item, f"an entry of {label}", high=65_536) for item in items]
    return tuple(value for value in values if value is not None) or None


_WHOLE = {"type": "integer", "minimum": 1, "maximum": 65_536}
INTEGERS = Kind(_integers, {"anyOf": [_WHOLE, {"type": "array", "items": _WHOLE}]})
"""Positive integers; a single one counts as a list."""


@dataclass(frozen=True, slots=True)
class PolicyDecl:
    """The section `policy`: network, its inputs, mirror symmetry of the system, and inner feedback."""

    type: str = key(word(("mlp",)), "kind of network", "mlp", label="`{name}` of the policy")
    hidden: tuple[int, ...] = key(INTEGERS, "widths of the hidden layers", (256, 256, 256))
    observe: tuple[ir.Num, ...] = key(
        _observed, "inputs of the network; every state unless given", (), spread=True
    )
    observe_text: tuple[str, ...] = field(default=(), compare=False)
    mirror: tuple[Assign, ...] = key(
        _mirror, "images of states and controls under a symmetry of system and specification", (), spread=True
    )
    mirror_span: Span | None = field(default=None, compare=False, repr=False)
    feedback: FeedbackDecl | None = key(_feedback, "a stabilising feedback beneath the plans", spread=True)
    feedback_span: Span | None = field(default=None, compare=False, repr=False)


# ------------------------------------------------------------------------------------- train


@dataclass(frozen=True, slots=True)
class TrainDecl:
    """The section `train`: training settings of this system; None leaves a setting to the training method."""

    budget: float | None = key(
        Kind(
            lambda cx, node, label: None if (time := cx.here.duration(node, label)) is None else float(time),
            EXPRESSION,
        ),
        "time for training; 60 s by default",
    )
    steps: int | None = key(integer(), "optimiser steps; takes precedence over `budget`")
    seed: int = key(integer(0, 2**63 - 1), "of everything random in training", 0)
    lr: float | None = key(number(1e-12), "learning rate")
    batch: int | None = key(integer(), "fresh initial states a step")
    samples: int | None = key(integer(), "size of the training set of `method: gradient`")
    method: str | None = key(word(METHODS, METHODS.installed), "training method")
    reward: ir.Num | None = key(
        _absolute, "reward of a step by states after it and controls in it, for `reward: task`"
    )
