"""`--set NAME=VALUE`: constants that the command line changes, and parameters that it fixes."""

from __future__ import annotations

from collections.abc import Mapping

from stlc.compile.frontend.interface import Interface
from stlc.diagnostics import Diagnostic, SpecError, UsageError
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse_expr
from stlc.registry import closest
from stlc.source import Source


def read_overrides(
    overrides: Mapping[str, str], spec: ast.Spec, interface: Interface | None
) -> dict[str, ast.Expr]:
    """Constant or parameter of the specification -> the expression that is its value.

    What the system has alone is left to it: constants, states and parameters that it carries, dotted keys.

    Raises:
        UsageError: U101, a name that neither has, or a value that is not an expression.
    """
    carried = set() if interface is None else {name.partition("[")[0] for name in interface.signature.names}
    systems = set() if interface is None else {*interface.constants, *carried}
    own = {item.name for item in spec.items if isinstance(item, ast.Const)}
    own |= {item.name for item in spec.items if isinstance(item, ast.Param)} - carried
    found: dict[str, ast.Expr] = {}
    faults: list[Diagnostic] = []
    for name, text in overrides.items():
        if name in own:
            try:
                found[name] = parse_expr(Source(f"--set {name}", text))
            except SpecError as error:
                faults.append(_unreadable(name, text, error))
        elif name not in systems and "." not in name:
            faults.append(_unknown(name, own | systems))
    if faults:
        raise UsageError(*faults)
    return found


def _unreadable(name: str, text: str, error: SpecError) -> Diagnostic:
    first = error.diagnostics[0]
    message = f"`--set {name}={text}`: {first.message}"
    return Diagnostic("U101", message, first.span, help=(f"write a value with its unit: `--set {name}=3s`",))


def _unknown(name: str, names: set[str]) -> Diagnostic:
    near = closest(name, names)
    known = f"constants: {', '.join(sorted(names))}" if names else "the specification has no constant"
    asks = f"did you mean `{near}`?  " if near is not None else ""
    return Diagnostic("U101", f"`--set {name}=…`: there is no constant `{name}`", help=(f"{asks}{known}",))
