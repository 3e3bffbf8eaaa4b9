"""`--set key=value`: fields replaced before anything is read, so that they are checked like written ones."""

from __future__ import annotations

from collections.abc import Mapping as MappingType
from dataclasses import replace

from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.init import InitDecl
from stlc.dynamics.declaration.model import Assign
from stlc.dynamics.init.shared_draws import shared_draws
from stlc.dynamics.schema.flow import state_assigns
from stlc.dynamics.schema.names import Names, base_name
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Entry, Mapping, Node, Scalar, Sequence, load_node
from stlc.registry import closest
from stlc.source import Source


def overridden(root: Mapping, overrides: MappingType[str, str], reader: Reader) -> Mapping:
    """The document with the fields that `overrides` names replaced.

    A dotted key names a field (`train.lr`, `init.mixture.0.weight`); a plain one a constant, a parameter, or
    a field at the top that holds a single value. Other plain names are left to the specification.
    """
    known, params = _keys(root.get("const")), _keys(root.get("param"))
    for key, text in overrides.items():
        value = _value(key, text, reader)
        path = key.split(".")
        if value is None:
            continue
        if len(path) == 1:
            if key in known:
                path = ["const", key]
            elif key in params:
                path = ["param", key, *(["draw"] if isinstance(params[key], Mapping) else [])]
            elif not isinstance(root.get(key), Scalar):
                continue
        changed = _replaced(root, path, value, key, reader)
        root = changed if isinstance(changed, Mapping) else root
    return root


def _keys(node: Node | None) -> dict[str, Node]:
    """What a section declares."""
    return {entry.key.text: entry.value for entry in node.entries} if isinstance(node, Mapping) else {}


def _value(key: str, text: str, reader: Reader) -> Node | None:
    """The value of an override, as a node of its own little text."""
    source = Source(f"--set {key}", text)
    try:
        return load_node(source, sink=reader.findings)
    except SystemFileError as error:
        reader.add(*error.diagnostics)
        return None


def _replaced(node: Node, path: list[str], value: Node, key: str, reader: Reader) -> Node:
    """`node` with the value at `path` replaced; keys that are not there are added."""
    head, rest = path[0], path[1:]
    match node:
        case Sequence(items=items) if head.isdigit() and int(head) < len(items):
            index = int(head)
            inner = _replaced(items[index], rest, value, key, reader) if rest else value
            return Sequence(node.span, (*items[:index], inner, *items[index + 1 :]), node.size + value.size)
        case Mapping():
            old = node.get(head) or Mapping(value.span, (), 1)
            inner = _replaced(old, rest, value, key, reader) if rest else value
            return node.replaced(Scalar(value.span, head), inner)
        case _:
            return _missing(node, head, value, key, reader)


def _missing(node: Node, head: str, value: Node, key: str, reader: Reader) -> Node:
    """Report a path that leads nowhere."""
    keys = [entry.key.text for entry in node.entries] if isinstance(node, Mapping) else []
    near = closest(head, keys)
    guess = f"did you mean `{near}`?" if near else f"keys here: {', '.join(keys)}" if keys else ""
    reader.report("S101", f"`--set {key}`: there is no `{head}` in the system file", value.span, guess)
    return node


def given_states(init: InitDecl, overrides: MappingType[str, str], reader: Reader, names: Names) -> InitDecl:
    """Initial states where `--set` names a state: `--set x=3m`, or how it is drawn instead."""
    params = {base_name(assign.name) for assign in init.params}
    here = names.expressions(reader).extended({}, samplers=True)
    found: list[Assign] = []
    for key, text in overrides.items():
        if names.group(key) and key not in params:
            node = _value(key, text, reader)
            if node is not None:
                entry = Entry(Scalar(node.span, key), node)
                found.extend(shared_draws(state_assigns(entry, "`--set`", here, names)))
    return replace(init, override=(*init.override, *found))
