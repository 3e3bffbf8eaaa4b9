"""Records of a system file: one description per key, for the reader, the JSON Schema and the documentation.

A record is a frozen dataclass with fields made by `key`:

    @dataclass(frozen=True, slots=True)
    class TrainDecl:
        steps: int | None = key(integer(), "optimiser steps; takes precedence over `budget`")

`read` fills it from a mapping of the file. Unknown keys, wrong kinds and values out of range are reported
with their source location, and the field keeps its default. `json_schema` and `reference` print the same
description. Records that only the reader uses (`…Keys`) are plain dataclasses, which take less time to
import.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from stlc.dynamics.declaration.schema.reader import MAX_NAME
from stlc.units import Unit

if TYPE_CHECKING:
    from stlc.dynamics.declaration.schema.names import Context
    from stlc.dynamics.declaration.schema.yaml_nodes import Node

R = TypeVar("R")
T = TypeVar("T")
V = TypeVar("V")
_Read: TypeAlias = "Callable[[Context, Node, str], Any]"
Json = dict[str, Any]
_KEY = "key"
_ZERO = {"0", "0 s", "0 steps"}
OF = "`{name}` of {of}"
"""Label of a value that also names its mapping."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of value, such as an integer or an expression.

    Attributes:
        read: function (context, node, label for messages) -> value, or None if a finding was reported.
        schema: JSON Schema of the accepted values.
        record: the dataclass into which the value, or each of its items, is read; None if it is not read into
            a dataclass.
    """

    read: _Read
    schema: Mapping[str, Any]
    record: type | None = None


@dataclass(frozen=True, slots=True)
class Key:
    """A key that a mapping of a system file may have.

    Attributes:
        attribute: name of the record's field that receives the value.
        name: name of the key in the file.
        kind: kind of the value.
        about: meaning of the value, for the documentation.
        label: name of the value in messages; `{of}` stands for the name of the mapping.
        required: whether the key is mandatory.
        spread: whether `kind.read` returns values of several fields, as a mapping by field name.
    """

    attribute: str
    name: str
    kind: Kind
    about: str
    label: str | Callable[[Mapping[str, Node]], str]
    required: bool
    spread: bool


def key(
    kind: Kind,
    about: str,
    default: Any = None,
    *,
    name: str = "",
    label: str | Callable[[Mapping[str, Node]], str] = "",
    required: bool = False,
    spread: bool = False,
    shown: bool = True,
) -> Any:
    """Make a field of a dataclass whose value is read from a key of a mapping in a system file.

    The key is called `name`, or like the field if `name` is empty. `kind` is the kind of its values. `about`
    is their meaning for the documentation. The other arguments are described in `Key`. If `shown` is False,
    comparison and `repr` leave the field out, because only the reader uses its value.
    """
    described = Key("", name, kind, about, label, required, spread)
    options: Json = {"default_factory": dict} if isinstance(default, dict) else {"default": default}
    return dataclasses.field(**options, metadata={_KEY: described}, repr=shown, compare=shown)


@cache
def keys_of(record: type) -> Mapping[str, Key]:
    """Return the keys that the mapping for the dataclass `record` may have: name -> key.

    They are in the order of the fields of `record`.
    """
    found = {}
    for each in dataclasses.fields(record):
        if _KEY in each.metadata:
            written: Key = each.metadata[_KEY]
            name = written.name or each.name
            found[name] = dataclasses.replace(written, attribute=each.name, name=name)
    return found


def values_of(
    record: type, cx: Context, node: Node | None, of: str, label: str = "`{name}`"
) -> dict[str, Any]:
    """Read and check the values of a mapping; return the valid ones, by name of the field of `record`.

    `of` names the mapping in messages. `label` is the pattern of a value's name in messages; `{name}` in it
    stands for the key. The pattern is used for keys that declare no label.
    """
    keys = keys_of(record)
    found = cx.reader.fields(node, of, tuple(keys), [name for name, each in keys.items() if each.required])
    values: dict[str, Any] = {}
    for name, each in keys.items():
        value = None
        if name in found:
            own = each.label if isinstance(each.label, str) else each.label(found)
            shown = (own or label).replace("{name}", name).replace("{of}", of)
            value = each.kind.read(cx, found[name], shown)
        if value is not None:
            values |= value if each.spread else {each.attribute: value}
    return values


def read(record: type[R], cx: Context, node: Node | None, of: str, label: str = "`{name}`") -> R:
    """Read a mapping into an object of the dataclass `record`.

    A missing value is replaced by its default. An invalid value is reported and replaced by its default. `of`
    names the mapping in messages, and `label` is the pattern of a value's name (see `values_of`).
    """
    return record(**values_of(record, cx, node, of, label))


# --------------------------------------------------------------------------------- kinds

EXPRESSION: Mapping[str, Any] = {"type": ["string", "number", "boolean"]}
VECTOR: Mapping[str, Any] = {"anyOf": [EXPRESSION, {"type": "array", "items": EXPRESSION}]}

TEXT = Kind(lambda cx, node, label: cx.reader.text(node, label), {"type": "string"})
LINE = Kind(
    lambda cx, node, label: " ".join((cx.reader.text(node, label) or "").split()) or None, {"type": "string"}
)
NAME = Kind(
    lambda cx, node, label: cx.reader.name(node, label), {"type": ["string", "number"], "maxLength": MAX_NAME}
)
FLAG = Kind(lambda cx, node, label: cx.reader.flag(node, label), {"type": "boolean"})
SECONDS = Kind(lambda cx, node, label: cx.here.duration(node, label), EXPRESSION)
"""A positive time, as a fraction of seconds."""
STEPS = Kind(lambda cx, node, label: cx.here.steps(node, label, cx.dt), EXPRESSION)
"""A positive number of steps, given as a number or as a time."""
INSTANT = Kind(
    lambda cx, node, label: 0 if getattr(node, "text", "").strip() in _ZERO else STEPS.read(cx, node, label),
    EXPRESSION,
)
"""An instant in steps from the start, given as a number or as a time."""
FORMULA = Kind(lambda cx, node, label: cx.here.formula(node, label), EXPRESSION)


def reads(schema: Mapping[str, Any], record: type | None = None) -> Callable[[_Read], Kind]:
    """Return a decorator that makes a `Kind` (a kind of value in a system file) from a reading function.

    `schema` is the JSON Schema of the accepted values. `record` is the dataclass into which a value, or each
    of its items, is read, if any.
    """
    return lambda read: Kind(read, schema, record)


def integer(low: int = 1, high: int = 10**9) -> Kind:
    """Return the `Kind` of an integer between `low` and `high`."""
    return Kind(
        lambda cx, node, label: cx.reader.integer(node, label, low=low, high=high),
        {"type": "integer", "minimum": low, "maximum": high},
    )


def number(low: float = 0.0) -> Kind:
    """Return the `Kind` of a finite number of at least `low`."""
    return Kind(
        lambda cx, node, label: cx.reader.number(node, label, low=low), {"type": "number", "minimum": low}
    )


def word(options: Iterable[str], known: Iterable[str] | None = None) -> Kind:
    """Return the `Kind` of a value that must be one of the words in `options`.

    If `options` are the names of a registry, they are looked up anew each time a value is read; `known` are
    those that the JSON Schema lists.
    """
    return Kind(
        lambda cx, node, label: cx.reader.option(
            node, label, tuple(options), getattr(options, "moved", None)
        ),
        {"enum": list(options if known is None else known)},
    )


@reads(EXPRESSION)
def fraction(cx: Context, node: Node, label: str) -> float | None:
    """Read a fraction: a number between 0 and 1, or a percentage. `label` names it in messages."""
    share = cx.here.constant(node, label, Unit.ONE)
    if share is not None and not 0.0 <= share <= 1.0:
        cx.reader.wrong(node, label, "a share between 0 and 1", "write `10 %`")
    return share


def raw(schema: Mapping[str, Any], record: type | None = None) -> Kind:
    """Return the `Kind` of a value that is kept as a YAML node, to be read later when more names are known.

    `schema` is the JSON Schema of the value, and `record` the dataclass into which it will be read, if any.
    """
    return Kind(lambda _cx, node, _label: node, schema, record)


def mapping_of(schema: Mapping[str, Any]) -> Json:
    """JSON Schema of a mapping with arbitrary keys, whose values meet `schema`.

    A null value (`~`) is allowed too; it removes an entry of an extended file.
    """
    return {
        "type": ["object", "null"],
        "additionalProperties": {"anyOf": [dict(schema), {"type": "null"}]},
    }


def items_of(schema: Mapping[str, Any]) -> Json:
    """JSON Schema of a list; null is accepted as an empty list."""
    return {"type": ["array", "null"], "items": dict(schema)}


def list_of(kind: Kind, label: str) -> Kind:
    """Return the `Kind` of a list whose items are of the kind `kind`.

    The list is read as a tuple. Invalid items are reported and left out. `label` names an item in
    messages.
    """

    def items(cx: Context, node: Node, where: str) -> tuple[Any, ...]:
        each = [kind.read(cx, item, label) for item in cx.reader.items(node, where)]
        return tuple(item for item in each if item is not None)

    return Kind(items, items_of(kind.schema), kind.record)


def part(record: type) -> Kind:
    """Return the `Kind` of a mapping in the file that is read into an object of the dataclass `record`."""
    return Kind(lambda cx, node, label: read(record, cx, node, label), json_schema(record), record)


def section(record: type, *, free: bool = False) -> Kind:
    """Return the `Kind` of a section of the file, which is kept as a YAML node and read later.

    A section has the keys of the dataclass `record`. If `free`, its keys are arbitrary names, and each value
    has the keys of `record`.
    """
    schema = json_schema(record)
    return raw(mapping_of(schema) if free else {**schema, "type": ["object", "null"]}, record)


def by_name(
    cx: Context, node: Node, label: str, known: Mapping[str, T], read: Callable[[Node, str, T], V | None]
) -> dict[str, V]:
    """Read a mapping whose keys must be in `known`; return its valid values by key.

    `read` takes the node of a value, its key, and the item of `known` at that key. `label` names the mapping
    in messages.
    """
    found: dict[str, V] = {}
    for entry in cx.reader.entries(node, label):
        name = entry.key.text
        if name not in known:
            cx.reader.unknown(entry.key, label, tuple(known))
        elif (value := read(entry.value, name, known[name])) is not None:
            found[name] = value
    return found


# ------------------------------------------------------------------- schema and documentation


def json_schema(record: type) -> Json:
    """Return the JSON Schema (draft 2020-12) of the mapping that is read into the dataclass `record`."""
    properties = {
        name: {**each.kind.schema, "description": each.about.replace("`", "")}
        for name, each in keys_of(record).items()
    }
    required = [name for name, each in keys_of(record).items() if each.required]
    found: Json = {"type": "object", "properties": properties, "additionalProperties": False}
    return found | ({"required": required} if required else {})


def reference(record: type, title: str) -> Iterator[str]:
    """Yield lines of Markdown: a table of the keys of `record`, then tables of the records in its values.

    `title` is the heading of the first table.
    """
    yield from (f"### {title}", "", "| key | value | default | meaning |", "|---|---|---|---|")
    fields = {each.name: each for each in dataclasses.fields(record)}
    inner: list[tuple[type, str]] = []
    for name, each in keys_of(record).items():
        default, shown = fields[each.attribute].default, ""
        if each.required:
            shown = "required"
        elif isinstance(default, (bool, int, float, str)) and default != "":
            shown = f"`{str(default).lower() if isinstance(default, bool) else default}`"
        elif isinstance(default, tuple) and default and all(isinstance(part, int) for part in default):
            shown = f"`{list(default)}`"
        yield f"| `{name}` | {_values(each.kind)} | {shown} | {each.about} |"
        if each.kind.record is not None:
            inner.append((each.kind.record, name if title == "The file" else f"{title}.{name}"))
    yield ""
    for found, called in inner:
        yield from reference(found, called)


def _values(kind: Kind) -> str:
    """Describe the values that a kind accepts in a few words."""
    schema = kind.schema
    if "enum" in schema:
        return ", ".join(f"`{option}`" for option in schema["enum"])
    types = schema.get("type", ())
    types = [types] if isinstance(types, str) else [each for each in types if each != "null"]
    match types:
        case ["integer"]:
            high = f" to {schema['maximum']}" if schema["maximum"] < 10**9 else ""
            return f"whole number from {schema['minimum']}{high}"
        case ["number"]:
            return f"number from {schema['minimum']:g}"
        case ["string"]:
            return "text"
        case ["boolean"]:
            return "`true`, `false`"
        case ["array"]:
            return "list"
        case ["object"]:
            return "mapping"
        case ["string", "number"]:
            return "name"
        case ["string", "number", "boolean"]:
            return "expression"
        case _:
            return " or ".join(_values(Kind(kind.read, each)) for each in schema.get("anyOf", ()))
