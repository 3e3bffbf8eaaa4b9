"""`extern fn`: declarations of functions that the system provides, such as forward kinematics."""

from __future__ import annotations

from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.scope import External, Scope
from stlc.compile.frontend.signals import MAX_COMPONENTS, declared_unit
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.registry import closest
from stlc.signature import Kind

_KINDS: dict[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


def external(item: ast.Extern, interface: Interface | None, about: str, scope: Scope) -> External:
    """The function that `item` declares. Raises Failed (E005, E101, E107)."""
    types = [formal.type for formal in item.formals]
    for written in (*types, item.type):
        if written is not None:
            _check_type(written, scope)
    if interface is not None and item.name not in interface.externs:
        scope.fail(_absent(item, interface))
    arguments = tuple(None if type_ is None else type_.size for type_ in types)
    loaded = None if interface is None else interface.functions.get(item.name)
    return External(
        name=item.name,
        arguments=arguments,
        result=item.type.size,
        unit=declared_unit(item.unit, item, scope),
        kind=_KINDS[item.type.name],
        function=None if loaded is None else loaded.bound(arguments, item.type.size),
        about=about,
        span=item.name_span,
    )


def _check_type(written: ast.TypeRef, scope: Scope) -> None:
    if written.name not in _KINDS:
        message = f"`{written.name}` cannot pass to or from a function outside"
        help_ = ("types: real, int, bool, and vectors `real[3]`",)
        scope.fail(Diagnostic("E101", message, written.span, help=help_))
    if written.size is not None and not 1 <= written.size <= MAX_COMPONENTS:
        message = f"a vector has between 1 and {MAX_COMPONENTS} components"
        scope.fail(Diagnostic("E005", message, written.span))


def _absent(item: ast.Extern, interface: Interface) -> Diagnostic:
    near = closest(item.name, interface.externs)
    asks = (f"did you mean `{near}`?",) if near is not None else ()
    line = f'functions: {{{item.name}: {{kind: python, target: "package.module:{item.name}"}}}}'
    return Diagnostic(
        "E107",
        f"the system provides no function `{item.name}`",
        item.name_span,
        f"declared here, absent from {interface.where}",
        help=(*asks, line),
    )
