"""The sections that say how a system is trained and guarded: objective, policy, train, backup."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from stlc.compile.frontend.algebra import absolute
from stlc.compile.frontend.scope import Entry, Known
from stlc.compile.frontend.values import Number, Vector
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.deployment import BackupDecl
from stlc.dynamics.declaration.learning import (
    START,
    FeedbackDecl,
    ObjectiveDecl,
    PolicyDecl,
    Term,
    TrainDecl,
)
from stlc.dynamics.model.algebra import names_in, substitute
from stlc.dynamics.schema.columns import read_levels
from stlc.dynamics.schema.expressions import SECOND, Expressions, written
from stlc.dynamics.schema.flow import component_texts
from stlc.dynamics.schema.mirror import read_mirror
from stlc.dynamics.schema.names import Names
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Node, Scalar, Sequence, as_int
from stlc.grammar import ast
from stlc.registry import METHODS
from stlc.runtime.prefixes import SAMPLINGS
from stlc.units import Unit

OBJECTIVE_KEYS = ("gamma", "smoothing", "lambda", "terms")
TERM_KEYS = ("name", "weight", "expr")
POLICY_KEYS = ("type", "hidden", "observe", "mirror", "feedback")
FEEDBACK_KEYS = ("around", "weights", "gain", "authority")
POLICIES = ("mlp",)
TRAIN_KEYS = ("budget", "steps", "seed", "lr", "batch", "samples", "method")
BACKUP_KEYS = ("bins", "levels", "T0", "batch", "samples", "sampling")
MOST_SAMPLES = 1 << 20
OUTCOME = {
    "sat": "1 where the trajectory satisfies the specification",
    "rho": "robustness of the trajectory",
    "k": "number of the step",
}


def read_objective(node: Node | None, reader: Reader, names: Names) -> ObjectiveDecl:
    """The section `objective`; terms read `sat`, `rho`, `k`, `t`, and `x_start`, where a state `x` began."""
    found = reader.fields(node, "`objective`", OBJECTIVE_KEYS)
    default = ObjectiveDecl()
    gamma = reader.number(found.get("gamma"), "`gamma`")
    smoothing = reader.number(found.get("smoothing"), "`smoothing`", low=1e-9)
    weight = reader.number(found.get("lambda"), "`lambda`")
    return ObjectiveDecl(
        default.gamma if gamma is None else gamma,
        default.smoothing if smoothing is None else smoothing,
        default.stl_weight if weight is None else weight,
        read_terms(found.get("terms"), "`terms`", reader, names),
    )


def read_terms(node: Node | None, where: str, reader: Reader, names: Names) -> tuple[Term, ...]:
    """A list of performance terms."""
    entries = {name: Known(Number(ir.Signal(name), flexible=True), about) for name, about in OUTCOME.items()}
    entries["t"] = Known(Number(ir.Signal("t"), SECOND), "seconds since the start of the plan")
    entries |= {
        f"{name}{START}": _first(names.entries[name]) for name in names.states if name in names.entries
    }
    here = names.expressions(reader).extended({n: e for n, e in entries.items() if n not in names.entries})
    return tuple(term for item in reader.items(node, where) for term in _term(item, here))


def _first(state: Entry) -> Known:
    """The value of a state at the start of the plan, whatever it is made of: a column may be converted."""
    assert isinstance(state, Known)
    about = "its value at the start of the plan"
    match state.value:
        case Number() as number:
            return Known(_began(number), about)
        case Vector(items) as vector:
            return Known(replace(vector, items=tuple(map(_began, items))), about)
        case _:
            return state


def _began(number: Number) -> Number:
    table = {name: ir.Signal(name + START) for name in names_in(number.num)}
    return replace(number, num=substitute(number.num, table))


def _term(node: Node, here: Expressions) -> tuple[Term, ...]:
    """One performance term."""
    reader = here.reader
    found = reader.fields(node, "a term", TERM_KEYS, required=("expr",))
    name = reader.name(found.get("name"), "`name` of a term") or written(found.get("expr"))
    weight = reader.number(found.get("weight"), "`weight`")
    value = here.number(found.get("expr"), f"the term `{name}`")
    return () if value is None else (Term(name, 1.0 if weight is None else weight, absolute(value).num),)


def read_policy(node: Node | None, reader: Reader, names: Names) -> PolicyDecl:
    """The section `policy`."""
    found = reader.fields(node, "`policy`", POLICY_KEYS)
    default = PolicyDecl()
    here = names.expressions(reader)
    seen = [seen for item in reader.items(found.get("observe"), "`observe`") for seen in _seen(item, here)]
    return PolicyDecl(
        reader.option(found.get("type"), "`type` of the policy", POLICIES) or default.type,
        _integers(found.get("hidden"), "`hidden`", reader) or default.hidden,
        tuple(number for number, _ in seen),
        tuple(text for _, text in seen),
        read_mirror(found.get("mirror"), reader, names),
        found["mirror"].span if "mirror" in found else None,
        read_feedback(found.get("feedback"), reader, names),
        found["feedback"].span if "feedback" in found else None,
    )


def read_feedback(node: Node | None, reader: Reader, names: Names) -> FeedbackDecl | None:
    """The entry `feedback` of the policy: `lqr`, or what is asked of it."""
    if node is None or (isinstance(node, Scalar) and node.is_null):
        return None
    if isinstance(node, Scalar):
        if node.text == "lqr":
            return FeedbackDecl()
        reader.wrong(node, "`feedback`", "`lqr`, or a mapping", "feedback: {weights: {angle: 10}}")
        return None
    found = reader.fields(node, "`feedback`", FEEDBACK_KEYS)
    units = {each.name: each.unit for each in names.columns} | {
        each.name: each.unit for each in names.controls
    }
    here = names.expressions(reader)
    around = _each(found.get("around"), "`around`", reader, units)
    gain: dict[str, dict[str, float]] = {}
    for entry in reader.entries(found.get("gain"), "`gain`"):
        if entry.key.text not in {each.name for each in names.controls}:
            reader.unknown(entry.key, "`gain`", tuple(each.name for each in names.controls))
            continue
        control = units[entry.key.text]
        row = _each(
            entry.value, f"`gain` of {entry.key.text}", reader, {c.name: c.unit for c in names.columns}
        )
        values = {
            name: here.constant(each, f"the gain of `{name}`", control / units[name])
            for name, each in row.items()
        }
        gain[entry.key.text] = {name: value for name, value in values.items() if value is not None}
    points = {name: here.constant(each, f"`{name}`", units[name]) for name, each in around.items()}
    weights = _each(found.get("weights"), "`weights`", reader, units)
    costs = {name: reader.number(each, f"the weight of `{name}`") for name, each in weights.items()}
    authority = reader.number(found.get("authority"), "`authority`")
    return FeedbackDecl(
        {name: value for name, value in points.items() if value is not None},
        {name: value for name, value in costs.items() if value is not None},
        gain,
        1.0 if authority is None else authority,
    )


def _each(node: Node | None, where: str, reader: Reader, known: Mapping[str, Unit]) -> dict[str, Node]:
    """Values by the names of columns."""
    found = {}
    for entry in reader.entries(node, where):
        if entry.key.text in known:
            found[entry.key.text] = entry.value
        else:
            reader.unknown(entry.key, where, tuple(known))
    return found


def _seen(node: Node, here: Expressions) -> tuple[tuple[ir.Num, str], ...]:
    """One item of `observe`: a number, a formula, or the components of a vector."""
    expr = here.parse(node, "an observation")
    if isinstance(expr, ast.Bool | ast.Compare | ast.Not | ast.Logic | ast.Member):
        value = here.truth(node, "an observation")
        return () if value is None else ((value, written(node)),)
    numbers = None if expr is None else here.numbers(node, "an observation")
    if numbers is None:
        return ()
    texts = (written(node),) if len(numbers) == 1 else component_texts(node, len(numbers))
    return tuple(zip((number.num for number in numbers), texts, strict=True))


def read_train(node: Node | None, reader: Reader, names: Names) -> TrainDecl:
    """The section `train`: defaults that the command line overrides."""
    found = reader.fields(node, "`train`", TRAIN_KEYS)
    budget = names.expressions(reader).duration(found["budget"], "`budget`") if "budget" in found else None
    return TrainDecl(
        None if budget is None else float(budget),
        reader.integer(found.get("steps"), "`steps`"),
        reader.integer(found.get("seed"), "`seed`", low=0, high=2**63 - 1) or 0,
        reader.number(found.get("lr"), "`lr`", low=1e-12),
        reader.integer(found.get("batch"), "`batch`"),
        reader.integer(found.get("samples"), "`samples`"),
        reader.option(found.get("method"), "`method`", METHODS.names),
    )


def read_backup(
    node: Node | None, reader: Reader, names: Names, horizon: int, where: str = "`backup`"
) -> BackupDecl:
    """The section `backup`, or that of a scenario."""
    found = reader.fields(node, where, BACKUP_KEYS)
    default = BackupDecl()
    lengths = _integers(found.get("T0"), "`T0`", reader) or default.lengths
    if "T0" in found and 0 < horizon < max(lengths):
        reader.report("S103", f"`T0` goes beyond the horizon of {horizon} steps", found["T0"].span)
    sampling = reader.option(found.get("sampling"), "`sampling`", SAMPLINGS)
    return BackupDecl(
        reader.integer(found.get("bins"), "`bins`", low=2) or default.bins,
        tuple(length for length in lengths if length <= horizon) or (1,),
        reader.integer(found.get("batch"), "`batch`") or default.batch,
        MappingProxyType(_levels(found.get("levels"), reader, names)),
        reader.integer(found.get("samples"), "`samples`", high=MOST_SAMPLES) or default.samples,
        next((each for each in SAMPLINGS if each == sampling), default.sampling),
    )


def _levels(node: Node | None, reader: Reader, names: Names) -> dict[str, tuple[float, ...]]:
    """Values of controls, in the place of what those declare themselves."""
    found = {}
    for entry in reader.entries(node, "`levels`"):
        name = entry.key.text
        meant = [each for each in names.controls if each.name == name or each.name.startswith(f"{name}[")]
        if not meant:
            reader.unknown(entry.key, "`levels`", tuple(each.name for each in names.controls))
        for control in meant:
            where, bounds = f"the control `{control.name}`", (control.low, control.high)
            levels = read_levels(entry.value, where, control.unit, bounds, names.expressions(reader))
            found[control.name] = levels or control.levels
    return found


def _integers(node: Node | None, where: str, reader: Reader) -> tuple[int, ...]:
    """A list of positive whole numbers; one alone counts as a list."""
    if isinstance(node, Scalar) and as_int(node) is not None:
        node = Sequence(node.span, (node,), 1)
    found = [reader.integer(item, f"an entry of {where}", high=65_536) for item in reader.items(node, where)]
    return tuple(value for value in found if value is not None)
