"""How a file is read for a specification: what words are worth, and which signals are discrete."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from stlc.grammar import ast
from stlc.signature import Kind
from stlc.trace import Reading
from stlc.trace_words import TRUTH, Words

_AS_DECLARED: Mapping[str, str] = MappingProxyType({})
_KINDS: Mapping[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


def reading_of(
    spec: ast.Spec, names: Mapping[str, str] = _AS_DECLARED, resample: float | None = None
) -> Reading:
    """How to read a file whose signals `spec` declares.

    Args:
        spec: the specification.
        names: signal -> its name in the file, where they differ.
        resample: seconds between the samples of a new grid; None takes the file's own.
    """
    return Reading(names, resample, _kinds(spec), _words(spec))


def _kinds(spec: ast.Spec) -> dict[str, Kind]:
    """What the numbers of a signal mean, as far as the specification says so."""
    signals = [item for item in spec.items if isinstance(item, ast.Signal) and item.type is not None]
    return {s.column or s.name: _KINDS.get(s.type.name, "enum") for s in signals if s.type is not None}


def _words(spec: ast.Spec) -> dict[str, Words]:
    """What the words of every signal are worth, as far as the specification says so."""
    members = {item.name: dict(item.members) for item in spec.items if isinstance(item, ast.Enum)}
    worth: dict[str, Words] = {"bool": TRUTH, **members}
    return {
        item.column or item.name: {} if item.type is None else worth.get(item.type.name, {})
        for item in spec.items
        if isinstance(item, ast.Signal)
    }
