"""Options for reading a file for a specification: numeric values of words, and discrete signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from stlc.grammar import ast
from stlc.signature import Kind
from stlc.trace import AS_IT_IS, Reading
from stlc.trace.enums import TRUTH, Words

_KINDS: Mapping[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


def reading_of(spec: ast.Spec, asked: Reading = AS_IT_IS) -> Reading:
    """Options for reading a file whose signals `spec` declares.

    Args:
        spec: the specification.
        asked: names in the file, of signals or of their columns (`from "…"`), and the grid.
    """
    columns = {item.name: item.column for item in spec.items if isinstance(item, ast.Signal) and item.column}
    names = {_column(columns, name): there for name, there in asked.names.items()}
    return replace(asked, names=names, kinds=_kinds(spec), words=_words(spec))


def _column(columns: Mapping[str, str], name: str) -> str:
    """The column name of a signal, or of a component of one: `p[0]` of `p from "q"` is `q[0]`."""
    base, bracket, index = name.partition("[")
    return columns.get(name) or f"{columns.get(base, base)}{bracket}{index}"


def _kinds(spec: ast.Spec) -> dict[str, Kind]:
    """The kind of each signal's numbers, where the specification gives it."""
    signals = [item for item in spec.items if isinstance(item, ast.Signal) and item.type is not None]
    return {s.column or s.name: _KINDS.get(s.type.name, "enum") for s in signals if s.type is not None}


def _words(spec: ast.Spec) -> dict[str, Words]:
    """The values of the words of each signal, where the specification gives them."""
    members = {item.name: dict(item.members) for item in spec.items if isinstance(item, ast.Enum)}
    worth: dict[str, Words] = {"bool": TRUTH, **members}
    return {
        item.column or item.name: {} if item.type is None else worth.get(item.type.name, {})
        for item in spec.items
        if isinstance(item, ast.Signal)
    }
