"""One-line doors to the front half of the compiler, for tests."""

from __future__ import annotations

from collections.abc import Mapping

from stlc.compile.frontend.interface import Interface
from stlc.compile.frontend.resolve import resolve
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import condition
from stlc.diagnostics import Diagnostic, StlcError
from stlc.grammar.spec import Spec
from stlc.source import Source

HEAD = """
state signal x, y [m]
state signal v [m/s]
state signal b, c : bool
state signal q : real[3] [m]
state signal p : real[2] [m]
signal n : int
enum Mode { off = 0, slow = 2, fast = 5 }
signal mode : Mode
"""


def spec(
    text: str, interface: Interface | None = None, overrides: Mapping[str, str] | None = None
) -> typed.Spec:
    return resolve(
        Spec.parse(Source("specs/spec.stl", text)), interface=interface, overrides=overrides, sink=[]
    )


def formula(text: str, before: str = "") -> typed.Formula:
    return spec(f"{HEAD}{before}\nrequire r: {text}\n").requirements[0].formula


def state(text: str, before: str = "") -> ir.Formula:
    return condition(formula(text, before))


def margin(text: str, before: str = "") -> ir.Num:
    """The number of a predicate `text > 0`."""
    found = formula(f"{text} > 0", before)
    assert isinstance(found, typed.Predicate)
    return found.num


def findings(text: str, **settings: object) -> list[Diagnostic]:
    sink: list[Diagnostic] = []
    try:
        resolve(Spec.parse(Source("specs/spec.stl", text)), sink=sink, **settings)  # type: ignore[arg-type]
    except StlcError as error:
        return [*sink, *error.diagnostics]
    return sink


def codes(text: str, **settings: object) -> list[str]:
    return [finding.code for finding in findings(text, **settings)]
