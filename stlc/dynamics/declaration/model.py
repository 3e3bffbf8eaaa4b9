"""How a system moves, as data: controls, assignments, jumps, and functions from outside."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.source import Span
from stlc.units import Unit

Squash: TypeAlias = Literal["tanh", "clip", "angle"]


@dataclass(frozen=True, slots=True)
class ControlDecl:
    """One control input.

    Attributes:
        name: as written.
        unit: of the numbers that are stored.
        low: lower end of its range, in `unit`.
        high: upper end.
        squash: how a network output becomes a value in the range.
        levels: the values that a search may try; empty where the range is sampled evenly.
    """

    name: str
    unit: Unit
    low: float
    high: float
    squash: Squash = "tanh"
    levels: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Feedback:
    """A linear feedback beneath the plans: actuators get clip(u0 + v + clip(K (x0 - x), -a, a), low, high).

    `v` is what is planned; everything is in the units of the columns.

    Attributes:
        gain: K, a row a control with an entry a state.
        state: x0, one a state.
        control: u0, one a control.
        low: lower ends of the actuators' ranges.
        high: upper ends.
        authority: a, how much the feedback adds at most, one a control.
    """

    gain: tuple[tuple[float, ...], ...]
    state: tuple[float, ...]
    control: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    authority: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Assign:
    """A column (or a local name) and its new value, in the unit of that column."""

    name: str
    value: ir.Num
    text: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class JumpDecl:
    """Where the guard holds at the start of a step, the resets replace what would have flowed."""

    name: str
    guard: ir.Formula
    resets: tuple[Assign, ...]
    sharpness: float | None = None
    text: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class FunctionDecl:
    """A function that specifications may call: in Python, on arrays, or known as numbers.

    Attributes:
        name: by which `extern fn` knows it.
        module: the module, or the file beside the system file, that holds it.
        attribute: its name there.
        library: the arrays that it takes; None takes what the caller has.
        span: where it is named.
        body: what it computes, from one vector to one, where the file says that; None for Python.
        base: of kinematics, the link that positions are relative to; "" is the root.
    """

    name: str
    module: str | Path
    attribute: str
    library: Literal["numpy", "torch"] | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    body: ir.Body | None = field(default=None, repr=False)
    base: str = ""

    def bound(self, arguments: tuple[int | None, ...], result: int | None) -> ir.Body:
        """What it computes; see `stlc.compile.frontend.interface.Function`. Raises SystemFileError (S208)."""
        assert self.body is not None
        takes, gives = len(self.body.formals), len(self.body.outputs)
        if (arguments, result) == ((takes,), gives):
            return self.body
        form = f"extern fn {self.name}(q: real[{takes}]) -> real[{gives}]"
        message = (
            f"`{self.name}` takes a vector of {takes} and gives one of {gives}, declared is another form"
        )
        raise SystemFileError(Diagnostic("S208", message, self.span, "named here", help=(form,)))
