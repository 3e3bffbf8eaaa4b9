"""The section `functions`: what specifications may call. Python is named, not loaded; kinematics is read."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from stlc.compile.frontend.scope import External
from stlc.dynamics.declaration.model import FunctionDecl
from stlc.dynamics.robots.kinematics import position
from stlc.dynamics.robots.urdf import chain, read_urdf
from stlc.dynamics.schema.names import Names
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Entry, Node
from stlc.units import parse_unit

KINDS = ("python", "urdf")
PYTHON_KEYS = ("kind", "target", "arrays")
URDF_KEYS = ("kind", "file", "tip", "base")
_TARGET = re.compile(r"(?P<module>[\w./-]+\.py|\w+(?:\.\w+)*):(?P<attribute>[^\W\d]\w*)")


def read_functions(node: Node | None, reader: Reader, names: Names) -> tuple[FunctionDecl, ...]:
    """Functions from outside; those known as numbers become names that expressions may call.

    `f: {kind: python, target: "package.module:function"}`, or `"file.py:function"` beside the file;
    `ee: {kind: urdf, file: arm.urdf, tip: flange}`: where that link is, from the positions of its joints.
    """
    found = [_function(entry, reader) for entry in reader.entries(node, "`functions`")]
    kept = tuple(function for function in found if function is not None)
    for function in kept:
        if function.body is not None:
            sizes = (len(function.body.formals),), len(function.body.outputs)
            names.entries[function.name] = External(
                function.name, *sizes, parse_unit("m"), "real", function.body, "function", function.span
            )
    return kept


def _function(entry: Entry, reader: Reader) -> FunctionDecl | None:
    where = f"the function `{entry.key.text}`"
    if not reader.nameable(entry.key, "the name of a function"):
        return None
    keys = tuple(dict.fromkeys((*PYTHON_KEYS, *URDF_KEYS)))
    found = reader.fields(entry.value, where, keys, required=("kind",))
    match reader.option(found.get("kind"), f"`kind` of {where}", KINDS):
        case "python":
            reader.fields(entry.value, where, PYTHON_KEYS, required=("target",))
            return _python(entry, found, where, reader) if "target" in found else None
        case "urdf":
            reader.fields(entry.value, where, URDF_KEYS, required=("file", "tip"))
            return _kinematics(entry, found, where, reader) if {"file", "tip"} <= found.keys() else None
        case _:
            return None


def _python(entry: Entry, found: dict[str, Node], where: str, reader: Reader) -> FunctionDecl | None:
    arrays = reader.option(found.get("arrays"), f"`arrays` of {where}", ("numpy", "torch"))
    target = found["target"]
    match = _TARGET.fullmatch(reader.text(target, f"`target` of {where}") or "")
    if match is None:
        wanted = "a module and a function"
        reader.wrong(
            target, f"`target` of {where}", wanted, 'write `"package.module:function"` or `"file.py:f"`'
        )
        return None
    module: str | Path = match["module"]
    if match["module"].endswith(".py"):
        module = Path(target.span.source.name).parent / match["module"]
    library: Literal["numpy", "torch"] | None = None
    if arrays is not None:
        library = "torch" if arrays == "torch" else "numpy"
    return FunctionDecl(entry.key.text, module, match["attribute"], library, target.span)


def _kinematics(entry: Entry, found: dict[str, Node], where: str, reader: Reader) -> FunctionDecl | None:
    """Forward kinematics of one link."""
    file, tip = (reader.text(found[key], f"`{key}` of {where}") for key in ("file", "tip"))
    base = reader.text(found.get("base"), f"`base` of {where}")
    if file is None or tip is None:
        return None
    place = found["file"].span
    path = Path(place.source.name).parent / file
    try:
        joints = chain(read_urdf(path), tip, base)
        if all(joint.kind == "fixed" for joint in joints):
            raise ValueError(f"no joint moves `{tip}`")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        reader.report("S208", f"`{file}` gives no kinematics: {reason}", place, label="named here")
        return None
    return FunctionDecl(entry.key.text, path, tip, span=place, body=position(joints), base=base or "")
