"""Section `functions`: references to Python functions (not loaded here), kinematics from URDF files."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from stlc.compile.frontend.scope import External
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.kinematics import chain, position, read_urdf
from stlc.dynamics.declaration.schema.names import Context
from stlc.dynamics.declaration.schema.record import OF, TEXT, key, read, word
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Mapping, Node
from stlc.files import named_in
from stlc.source import Span
from stlc.units import Unit

_TARGET = re.compile(r"(?P<module>[\w./-]+\.py|\w+(?:\.\w+)*):(?P<attribute>[^\W\d]\w*)")
_OWN = {"python": ("kind", "target", "arrays"), "urdf": ("kind", "file", "tip", "base")}


@dataclass(frozen=True, slots=True)
class FunctionDecl:
    """External function that specifications may call: a Python function, or the kinematics of a robot.

    Attributes:
        name: its name in the declaration `extern fn` of a specification.
        module: Python module, or path of the Python or URDF file that defines the function.
        attribute: name of the function within that module; for kinematics, the link whose position is
            computed.
        library: array library of its arguments; None accepts the arrays of any caller.
        span: source location of its name.
        body: for kinematics, expressions that compute the result vector from one argument vector; None for a
            Python function.
        base: for kinematics, the link that positions are relative to; "" is the root.
    """

    name: str
    module: str | Path
    attribute: str
    library: Literal["numpy", "torch"] | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    body: ir.Body | None = field(default=None, repr=False)
    base: str = ""

    def bound(self, arguments: tuple[int | None, ...], result: int | None) -> ir.Body:
        """Return the expressions of the function (`body`); check the sizes that a specification declares.

        Args:
            arguments: declared size of each argument, the number of components of a vector; None for a
                number.
            result: declared size of the result; None for a number.

        Raises:
            SystemFileError: S208, the declared sizes differ from those of the function.
        """
        assert self.body is not None
        takes, gives = len(self.body.formals), len(self.body.outputs)
        if (arguments, result) == ((takes,), gives):
            return self.body
        form = f"extern fn {self.name}(q: real[{takes}]) -> real[{gives}]"
        message = (
            f"`{self.name}` takes a vector of {takes} and gives one of {gives}, declared is another form"
        )
        raise SystemFileError.of("S208", message, self.span, "named here", help=(form,))


@dataclass(repr=False, eq=False)
class FunctionKeys:
    """The keys that one entry of `functions` may have."""

    kind: str | None = key(word(_OWN), "origin of the function", required=True)
    target: str | None = key(TEXT, "of `python`: `package.module:function` or `file.py:function`")
    arrays: Literal["numpy", "torch"] | None = key(
        word(("numpy", "torch")), "of `python`: the arrays that it takes"
    )
    file: str | None = key(TEXT, "of `urdf`: the robot description")
    tip: str | None = key(TEXT, "of `urdf`: the link whose position is wanted")
    base: str | None = key(TEXT, "of `urdf`: the link that positions are relative to")


def read_functions(node: Node | None, cx: Context) -> tuple[FunctionDecl, ...]:
    """Read the section `functions`; kinematics can also be called in the system file itself.

    `f: {kind: python, target: "package.module:function"}` is a Python function; `"file.py:function"` refers
    to a file beside the system file. `ee: {kind: urdf, file: arm.urdf, tip: flange}` is the position of the
    link `flange` as a function of the joint positions.
    """
    found = [_function(entry, cx) for entry in cx.reader.entries(node, "`functions`")]
    kept = tuple(function for function in found if function is not None)
    for function in kept:
        if function.body is not None:
            sizes = (len(function.body.formals),), len(function.body.outputs)
            cx.names.entries[function.name] = External(
                function.name, *sizes, Unit.parse("m"), "real", function.body, "function", function.span
            )
    return kept


def _function(entry: Entry, cx: Context) -> FunctionDecl | None:
    where = f"the function `{entry.key.text}`"
    if not cx.reader.nameable(entry.key, "the name of a function"):
        return None
    keys = read(FunctionKeys, cx, entry.value, where, OF)
    if keys.kind is None or not isinstance(entry.value, Mapping):
        return None
    needed = ("target",) if keys.kind == "python" else ("file", "tip")
    cx.reader.fields(entry.value, where, _OWN[keys.kind], required=needed)
    if any(getattr(keys, name) is None for name in needed):
        return None
    return _python(entry, keys, where, cx) if keys.kind == "python" else _kinematics(entry, keys, cx)


def _python(entry: Entry, keys: FunctionKeys, where: str, cx: Context) -> FunctionDecl | None:
    place = entry.place("target")
    match = _TARGET.fullmatch(keys.target or "")
    if match is None:
        assert isinstance(entry.value, Mapping)
        target, advice = entry.value.get("target"), 'write `"package.module:function"` or `"file.py:f"`'
        assert target is not None
        cx.reader.wrong(target, f"`target` of {where}", "a module and a function", advice)
        return None
    module: str | Path = match["module"]
    if match["module"].endswith(".py"):
        module = named_in(place.source, match["module"])
    return FunctionDecl(entry.key.text, module, match["attribute"], keys.arrays, place)


def _kinematics(entry: Entry, keys: FunctionKeys, cx: Context) -> FunctionDecl | None:
    """Read the forward kinematics of one link from a URDF file.

    `entry` is the entry of the function, and `keys` are its values. Reports S208 and returns None if the file
    is unusable or no joint moves the link.
    """
    file, tip, place = keys.file or "", keys.tip or "", entry.place("file")
    path = named_in(place.source, file)
    try:
        joints = chain(read_urdf(path), tip, keys.base)
        if all(joint.kind == "fixed" for joint in joints):
            raise ValueError(f"no joint moves `{tip}`")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        cx.reader.report("S208", f"`{file}` gives no kinematics: {reason}", place, label="named here")
        return None
    return FunctionDecl(entry.key.text, path, tip, span=place, body=position(joints), base=keys.base or "")
