"""The section `scenario`: named overlays of a deployment, each checked whether it is chosen or not."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from stlc.compile.frontend.scope import Known
from stlc.compile.frontend.values import Number
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.deployment import ErrorsDecl, ScenarioDecl
from stlc.dynamics.declaration.model import Assign
from stlc.dynamics.schema.deploy import read_event, read_judge, read_world
from stlc.dynamics.schema.expressions import SECOND, Expressions, written
from stlc.dynamics.schema.flow import rate_unit, read_sets, states_of
from stlc.dynamics.schema.names import Clockwork, Names
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.settings import read_backup, read_terms
from stlc.dynamics.schema.yaml_nodes import Entry, Node
from stlc.units import DIMENSIONLESS

SCENARIO_KEYS = (
    "doc",
    "expect",
    "const",
    "override",
    "events",
    "disturb",
    "noise",
    "model_mismatch",
    "errors",
    "world",
    "prefer",
    "backup",
    "judge",
)
ERROR_KEYS = ("actuator_gain", "parameters", "actuator_noise", "sensor_noise")
EXPECTED = ("nominal", "ood")


def read_scenarios(
    node: Node | None, reader: Reader, names: Names, clock: Clockwork
) -> tuple[ScenarioDecl, ...]:
    """All overlays, in the order of the file."""
    return tuple(
        _scenario(entry, reader, names, clock)
        for entry in reader.entries(node, "`scenario`")
        if reader.nameable(entry.key, "the name of a scenario")
    )


def _scenario(entry: Entry, reader: Reader, names: Names, clock: Clockwork) -> ScenarioDecl:
    where = f"the scenario `{entry.key.text}`"
    found = reader.fields(entry.value, where, SCENARIO_KEYS)
    timed = _timed(names.expressions(reader), names)
    added = replace(timed, amounts=True)
    items = reader.items(found.get("events"), f"`events` of {where}")
    return ScenarioDecl(
        entry.key.text,
        " ".join((reader.text(found.get("doc"), f"`doc` of {where}") or "").split()),
        reader.option(found.get("expect"), f"`expect` of {where}", EXPECTED) or "nominal",
        MappingProxyType(_constants(found.get("const"), f"`const` of {where}", reader, names)),
        read_sets(found.get("override"), f"`override` of {where}", timed, names),
        tuple(read_event(item, index, timed, names, clock.dt) for index, item in enumerate(items)),
        _rates(found.get("disturb"), f"`disturb` of {where}", added, (names, clock)),
        read_sets(found.get("noise"), f"`noise` of {where}", added, names),
        MappingProxyType(
            _constants(found.get("model_mismatch"), f"`model_mismatch` of {where}", reader, names)
        ),
        read_world(found.get("world"), reader),
        _errors(found.get("errors"), f"`errors` of {where}", timed),
        read_terms(found.get("prefer"), f"`prefer` of {where}", reader, names),
        read_backup(found["backup"], reader, names, clock.horizon, f"`backup` of {where}")
        if "backup" in found
        else None,
        read_judge(found.get("judge"), reader),
    )


def _errors(node: Node | None, where: str, here: Expressions) -> ErrorsDecl:
    """Shares such as `10 %` or `0.1`."""
    found = here.reader.fields(node, where, ERROR_KEYS)
    shares = {key: here.constant(value, f"`{key}`", DIMENSIONLESS) for key, value in found.items()}
    for key, share in shares.items():
        if share is not None and not 0.0 <= share <= 1.0:
            here.reader.wrong(found[key], f"`{key}`", "a share between 0 and 1", "write `10 %`")
    return ErrorsDecl(**{key: share for key, share in shares.items() if share is not None})


def _timed(here: Expressions, names: Names) -> Expressions:
    """Expressions that may draw, and know the time of the deployment."""
    clock = Known(Number(ir.Signal("t"), SECOND), "seconds since the start of the deployment")
    return here.extended({"t": clock} if "t" not in names.places else {}, samplers=True)


def _constants(node: Node | None, where: str, reader: Reader, names: Names) -> dict[str, str]:
    """Constants and their other values, as text."""
    found: dict[str, str] = {}
    for entry in reader.entries(node, where):
        name = entry.key.text
        if name not in names.constants and f"{name}[0]" not in names.constants:
            reader.unknown(entry.key, where, tuple(names.constants))
        elif names.expressions(reader).numbers(entry.value, f"`{name}`") is not None:
            found[name] = written(entry.value) or entry.value.span.text
    return found


def _rates(
    node: Node | None, where: str, here: Expressions, known: tuple[Names, Clockwork]
) -> tuple[Assign, ...]:
    """What is added to derivatives (or next values), in the unit of the state per second."""
    names, clock = known
    found: list[Assign] = []
    for entry in here.reader.entries(node, where):
        columns = states_of(entry, where, here.reader, names)
        if not columns:
            continue
        unit = columns[0].unit if clock.discrete else rate_unit(columns[0].unit)
        values = here.stored_each(entry.value, f"`{entry.key.text}`", unit, len(columns))
        text = written(entry.value)
        found.extend(Assign(c.name, value, text) for c, value in zip(columns, values or (), strict=False))
    return tuple(found)
