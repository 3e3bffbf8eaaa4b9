"""JSON that every reader accepts: conversion of values, writing and parsing.

Numbers that are not finite become texts, arrays become lists, and paths become texts.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from fractions import Fraction
from functools import cache
from pathlib import PurePath
from typing import Annotated, Any, TypeAlias

from stlc.escape import json_text

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
Num: TypeAlias = Annotated[float, "unbounded"]
"""Number of a record that need not be finite."""
Count: TypeAlias = Annotated[int, 0]
"""Whole number of a record from 0 on."""


@dataclass(frozen=True, slots=True)
class Key:
    """Key of a record in JSON: its name, its (dotted) attribute, and its mark.

    A key with the mark `?` is left out where its value is None or empty, one with `??` where it is None.
    """

    name: str
    attribute: str
    mark: str = ""


@cache
def keys_of(kind: type) -> tuple[Key, ...]:
    """Keys of a dataclass: its fields, or the words of its attribute `JSON`: `key`, `key=attribute`, `key?`.

    An attribute of a record that may be None is left out where that is None.
    """
    words = getattr(kind, "JSON", None) or " ".join(field.name for field in fields(kind))
    parts = [word.partition("=") for word in words.split()]
    names = [(name.rstrip("?"), name, attribute) for name, _, attribute in parts]
    return tuple(Key(name, attribute or name, word[len(name) :]) for name, word, attribute in names)


def keys_below(field: str, kind: type) -> str:
    """Words of `JSON` for the keys of a record among those of another, which has it as a field."""
    keys = keys_of(kind)
    return " ".join(f"{key.name}{key.mark}={field}.{key.attribute}" for key in keys)


def plain(value: object) -> Json:
    """Convert a value to JSON data: None, booleans, numbers, texts, lists and dictionaries.

    Numbers that are not finite become the texts "inf", "-inf" and "nan"; mappings, dataclasses,
    sequences, sets, arrays and array scalars are converted recursively; paths become texts.

    Raises:
        TypeError: `value` contains an object of another type.
    """
    match value:
        case None | bool() | str():
            return value
        case Enum():
            return plain(value.value)
        case int():
            return int(value)
        case float() | Fraction():
            number = float(value)
            if math.isfinite(number):
                return number
            return "nan" if math.isnan(number) else "inf" if number > 0 else "-inf"
        case Mapping():
            return {str(key): plain(item) for key, item in value.items()}
        case list() | tuple() | set() | frozenset():
            return [plain(item) for item in value]
        case PurePath():
            return value.as_posix()
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(each) for name, each in _entries(value, keys_of(type(value)))}
    to_list = getattr(value, "tolist", None)
    if to_list is None:
        raise TypeError(f"{type(value).__name__} is no JSON data")
    return plain(to_list())


def _entries(record: object, keys: Iterable[Key]) -> Iterator[tuple[str, object]]:
    """The keys of a record that are not left out, and their values."""
    for key in keys:
        *above, last = key.attribute.split(".")
        owner = record
        for name in above:
            owner = None if owner is None else getattr(owner, name)
        if owner is None:
            continue
        value = getattr(owner, last)
        blank = isinstance(value, str | list | tuple | dict) and not value
        if not (key.mark and value is None) and not (key.mark == "?" and blank):
            yield key.name, value


def dumps(value: object, *, indent: int | None = None) -> str:
    """Return the JSON text of a value, converted as by `plain`; on one line unless `indent` is given.

    Invisible characters, and lone surrogates, which UTF-8 cannot encode, are escaped.
    """
    return json_text(json.dumps(plain(value), indent=indent, ensure_ascii=False, allow_nan=False))


_DEEPEST, _LARGEST = 100, 1e100


def data_of(text: str | bytes | Json) -> Any:
    """Parse untrusted JSON; data that were parsed before are checked alike.

    Raises:
        ValueError: the text is no JSON in UTF-8, nests more than 100 deep, or holds a number that is not
            finite or beyond 1e100. The message names the key.
        RecursionError: the text is nested too deeply to be read.
    """
    given = text.decode("utf-8") if isinstance(text, bytes) else text
    value = loads(given) if isinstance(given, str) else given
    _require_plain(value, "", _DEEPEST)
    return value


def _require_plain(value: Json, key: str, depth: int) -> None:
    if depth < 0:
        raise ValueError(f"`{key[:60]}` is nested more than {_DEEPEST} deep")
    if isinstance(value, dict | list):
        for name, item in value.items() if isinstance(value, dict) else enumerate(value):
            _require_plain(item, f"{key}.{name}" if key else str(name), depth - 1)
    elif isinstance(value, int | float) and not abs(value) <= _LARGEST:
        raise ValueError(f"`{key}` is not finite, or is too large")


_ESCAPES = re.compile(r"(\\\\|\\u[dD][89abAB]..\\u[dD][c-fC-F]..)|\\u[dD][89a-fA-F]..|[\ud800-\udfff]")


def loads(text: str) -> Any:
    """Parse untrusted JSON text; lone surrogates, which UTF-8 cannot encode, become U+FFFD.

    Raises:
        ValueError: the text is not JSON.
        RecursionError: the text is nested too deeply.
    """
    return json.loads(_ESCAPES.sub(lambda match: match[1] or "\ufffd", text))
