"""JSON that every reader accepts: conversion of values, writing and parsing.

Numbers that are not finite become texts, arrays become lists, and paths become texts.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from fractions import Fraction
from pathlib import PurePath
from typing import Any, TypeAlias

from stlc.escape import json_text

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"


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
            return _number(float(value))
        case Mapping():
            return {str(key): plain(item) for key, item in value.items()}
        case list() | tuple() | set() | frozenset():
            return [plain(item) for item in value]
        case PurePath():
            return value.as_posix()
    return _foreign(value)


def _foreign(value: object) -> Json:
    """Convert an object to JSON data: a dataclass, or an array with a method `tolist` (NumPy, torch).

    Raises:
        TypeError: the object is neither.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {entry.name: plain(getattr(value, entry.name)) for entry in fields(value)}
    to_list = getattr(value, "tolist", None)
    if to_list is None:
        raise TypeError(f"{type(value).__name__} is no JSON data")
    return plain(to_list())


def _number(value: float) -> float | str:
    if math.isfinite(value):
        return value
    return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"


def dumps(value: object, *, indent: int | None = None) -> str:
    """Return the JSON text of a value, converted as by `plain`; on one line unless `indent` is given.

    Invisible characters, and lone surrogates, which UTF-8 cannot encode, are escaped.
    """
    return json_text(json.dumps(plain(value), indent=indent, ensure_ascii=False, allow_nan=False))


_ESCAPES = re.compile(r"(\\\\|\\u[dD][89abAB]..\\u[dD][c-fC-F]..)|\\u[dD][89a-fA-F]..|[\ud800-\udfff]")


def loads(text: str) -> Any:
    """Parse untrusted JSON text; lone surrogates, which UTF-8 cannot encode, become U+FFFD.

    Raises:
        ValueError: the text is not JSON.
        RecursionError: the text is nested too deeply.
    """
    return json.loads(_ESCAPES.sub(lambda match: match[1] or "\ufffd", text))
