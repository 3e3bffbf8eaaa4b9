"""Records and JSON: schemas derived from dataclasses, and stored documents read back into them.

`stlc.jsontext.plain` writes a record: each field under its name, or what the class attribute `JSON` lists.
"""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache, reduce
from importlib import import_module
from operator import or_
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from stlc.diagnostics import RunError
from stlc.jsontext import Json, Key, data_of, keys_of

R = TypeVar("R")

_NAMES: dict[Any, str] = {str: "string", int: "integer", float: "number", bool: "boolean"}
_NAMES |= {types.NoneType: "null", Path: "string"}
_NOUNS = {int: "a whole number", float: "a number", str: "a text", bool: "true or false", Path: "a path"}
_NOUNS |= {types.NoneType: "null"}
_INFINITE = {"inf": float("inf"), "-inf": float("-inf"), "nan": float("nan")}
_UNIONS = (Union, types.UnionType)
_LISTS = (list, tuple, Sequence)


@cache
def hints_of(kind: type) -> dict[Key, tuple[Any, bool]]:
    """Key of a record's JSON -> type of its value, and whether the key is always there."""
    found = {}
    for key in keys_of(kind):
        owner: Any = kind
        there = not key.mark
        *above, last = key.attribute.split(".")
        for name in above:
            hint = _hint(owner, name)
            owner = _present(hint)
            there &= owner is hint
        hint = _hint(owner, last)
        found[key] = (_present(hint) if key.mark == "??" else hint, there)
    return found


def _present(hint: Any) -> Any:
    """Type of a value that is there: `X` of `X | None`."""
    others = [each for each in get_args(hint) if each is not types.NoneType]
    return others[0] if get_origin(hint) in _UNIONS and len(others) == 1 else hint


def _hint(kind: type, name: str) -> Any:
    """Type of an attribute of a class: that of a field, or what a property returns.

    Its `NAMES` are the modules of classes in its annotations that it does not import.
    """
    for owner in kind.__mro__:
        own = vars(owner).get(name)
        accessor = getattr(own, "fget", None) or getattr(own, "func", None)  # a property, cached or not
        hint = vars(owner).get("__annotations__", {}).get(name)
        if accessor is not None or hint is not None:
            found = hint if accessor is None else accessor.__annotations__["return"]
            space = {"__annotations__": {name: found}, "__module__": owner.__module__}
            places = getattr(owner, "NAMES", {}).items()
            later = {word: getattr(import_module(module), word) for word, module in places}
            return get_type_hints(type("Wanted", (), space), localns=later, include_extras=True)[name]
    raise AttributeError(f"{kind.__name__} has no {name}")


# ------------------------------------------------------------------------- schemas


def schema_of(kind: Any) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of the values of a type, as `stlc.jsontext.plain` writes them."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return {}
    if kind is None:
        return {"type": "null"}
    if kind in _NAMES:
        return {"type": _NAMES[kind]}
    if is_dataclass(kind):
        hints = hints_of(kind)  # type: ignore[arg-type]
        inner = {key.name: schema_of(hint) for key, (hint, _) in hints.items()}
        needed = [key.name for key, (_, there) in hints.items() if there]
        return {"type": "object", "properties": inner} | ({"required": needed} if needed else {})
    if origin is Annotated:
        what = args[1]() if callable(args[1]) else args[1]
        if what == "unbounded":
            return {"type": ["number", "string"]}
        return {**schema_of(args[0]), "minimum": what} if isinstance(what, int) else {"enum": list(what)}
    if origin is Literal:
        return {"enum": list(args)}
    if origin in (dict, Mapping):
        return {"type": "object"} | ({} if args[1] is Any else {"additionalProperties": schema_of(args[1])})
    if origin is tuple and Ellipsis not in args:
        of = schema_of(reduce(or_, dict.fromkeys(args)))
        return {"type": "array", "items": of, "minItems": len(args), "maxItems": len(args)}
    if origin in _LISTS:
        return {"type": "array", "items": schema_of(args[0])}
    if origin in _UNIONS:
        return _union([schema_of(each) for each in args])
    return {"type": "array", "items": {"type": ["number", "string"]}}  # an array of numbers


def _union(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the JSON Schema of a value that matches one of the schemas `parts`.

    Schemas that consist of a type only are joined into one: `{"type": ["string", "null"]}`.
    """
    plain = [part["type"] for part in parts if part.keys() == {"type"}]
    rest = [part for part in parts if part.keys() != {"type"}]
    if not rest:
        return {"type": [name for each in plain for name in ([each] if isinstance(each, str) else each)]}
    if len(rest) == 1 and plain == ["null"] and "type" in rest[0]:
        return {**rest[0], "type": [rest[0]["type"], "null"]}
    return {"anyOf": parts}


# ------------------------------------------------------------------------- reading


def from_json(kind: type[R], document: str | bytes | Json, file: Path | str, *, code: str = "R101") -> R:
    """Read a record that stlc has stored, and that anybody may have changed.

    Keys that the record does not have are left out; one that is missing or null takes the default of its
    field.

    Args:
        kind: the record, a dataclass; anything that `schema_of` knows.
        document: the text of the file, or its content as JSON data.
        file: name of the file in the diagnostic.
        code: code of the diagnostic.

    Raises:
        RunError: `code`, the text is no JSON, holds a number that is not finite or beyond 1e100, or a key is
            missing or of another type; the note names the key.
    """
    try:
        found: R = read(kind, data_of(document))
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]
        raise RunError.of(code, f"`{file}` is damaged", note=(reason,)) from None
    return found


def read(kind: Any, value: Json, key: str = "") -> Any:
    """Return JSON data as a value of a type. Raises ValueError, which names the key, for other data."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if is_dataclass(kind):
        return _read_record(kind, value, key)  # type: ignore[arg-type]
    if origin is Annotated:
        if args[1] == "unbounded" and isinstance(value, str) and value in _INFINITE:
            return _INFINITE[value]
        found = read(args[0], value, key)
        if isinstance(args[1], int) and found < args[1]:
            raise _unlike(value, f"a number from {args[1]} on", key)
        return found
    if origin is Literal:
        if not any(value == each and type(value) is type(each) for each in args):
            raise _unlike(value, f"one of {', '.join(map(str, args))}", key)
        return value
    if origin in _UNIONS:
        return _read_union(args, value, key)
    if origin in (dict, Mapping):
        if not isinstance(value, dict):
            raise _unlike(value, "a JSON object", key)
        return {name: read(args[1], each, _below(key, name)) for name, each in value.items()}
    if origin in _LISTS:
        fixed = origin is tuple and Ellipsis not in args
        if not isinstance(value, list) or (fixed and len(value) != len(args)):
            raise _unlike(value, f"a list of {len(args)}" if fixed else "a list", key)
        items = [read(args[n if fixed else 0], each, _below(key, n)) for n, each in enumerate(value)]
        return items if origin is list else tuple(items)
    accepted: Any = {float: (float, int), Path: str}.get(kind, kind)
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise _unlike(value, _NOUNS[kind], key)
    return Path(str(value)) if kind is Path else float(value) if kind is float else value


def _read_record(kind: type, value: Json, key: str) -> Any:
    if not isinstance(value, dict):
        raise _unlike(value, "a JSON object", key)
    own, given = {each.name: each for each in fields(kind)}, {}
    for each, (hint, _) in hints_of(kind).items():
        field = own.get(each.attribute)
        if field is None or not field.init:
            continue
        if each.name in value and not (value[each.name] is None and _has_default(field)):
            given[each.attribute] = read(hint, value[each.name], _below(key, each.name))
        elif not _has_default(field):
            raise ValueError(f"{f'`{key}`' if key else 'it'} has no `{each.name}`")
    return kind(**given)


def _has_default(field: Field[Any]) -> bool:
    return field.default is not MISSING or field.default_factory is not MISSING


def _read_union(kinds: Sequence[Any], value: Json, key: str) -> Any:
    if value is None and types.NoneType in kinds:
        return None
    others = [each for each in kinds if each is not types.NoneType]
    errors = []
    for each in others:
        try:
            return read(each, value, key)
        except ValueError as error:
            errors.append(error)
    if len(others) == 1:
        raise errors[0]
    raise _unlike(value, " or ".join(_NOUNS.get(each, "a record") for each in others), key)


def _below(key: str, name: object) -> str:
    return f"{key}.{name}" if key else str(name)


def _unlike(value: Json, noun: str, key: str) -> ValueError:
    return ValueError(f"{f'`{key}`' if key else 'it'} is {value!r:.40}, not {noun}")
