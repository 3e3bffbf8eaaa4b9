"""The section `functions`: Python functions that specifications may call. They are named here, not loaded."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from stlc.dynamics.decl import FunctionDecl
from stlc.dynamics.schema_reader import Reader
from stlc.dynamics.yaml_nodes import Entry, Node

FUNCTION_KEYS = ("kind", "target", "arrays")
_TARGET = re.compile(r"(?P<module>[\w./-]+\.py|\w+(?:\.\w+)*):(?P<attribute>[^\W\d]\w*)")


def read_functions(node: Node | None, reader: Reader) -> tuple[FunctionDecl, ...]:
    """`ee: {kind: python, target: "package.module:function"}`, or `"file.py:function"` beside the file."""
    found = [_function(entry, reader) for entry in reader.entries(node, "`functions`")]
    return tuple(function for function in found if function is not None)


def _function(entry: Entry, reader: Reader) -> FunctionDecl | None:
    name = entry.key.text
    where = f"the function `{name}`"
    found = reader.fields(entry.value, where, FUNCTION_KEYS, required=("kind", "target"))
    reader.option(found.get("kind"), f"`kind` of {where}", ("python",))
    arrays = reader.option(found.get("arrays"), f"`arrays` of {where}", ("numpy", "torch"))
    if "target" not in found:
        return None
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
    return FunctionDecl(name, module, match["attribute"], library, target.span)
