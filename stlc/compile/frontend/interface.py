"""Interface of a system: the data about a system that the compiler needs.

The compiler works with this interface alone. It does not need to load the system.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from stlc.compile.ir import nodes as ir
from stlc.signature import Signature
from stlc.source import Span
from stlc.units import Unit


class InterfaceFunction(Protocol):
    """Function that a system provides, such as forward kinematics."""

    def bound(
        self, arguments: tuple[int | None, ...], result: int | None
    ) -> Callable[..., Sequence[Any]] | ir.Body:
        """Return the function in the form that the compiler calls.

        Args:
            arguments: size of each vector argument; None for a number.
            result: size of the result; None for a number.

        Returns:
            Function from the components of all arguments to the components of the result, all of them
                broadcastable arrays; or the body of the function in the IR.
        """


@dataclass(frozen=True, slots=True)
class Interface:
    """States, constants and functions that a system provides to a specification.

    Attributes:
        name: name of the system.
        signature: states in order, with the units in which they are stored.
        constants: (value in SI units, unit) of each constant, by name.
        externs: names of the functions that the system provides.
        functions: loaded functions, by name.
        path: path of the system file, for messages.
        places: source location of each state and constant in the system file, by name.
        unread: names of the system file that no specification can use: name -> advice.
    """

    name: str
    signature: Signature
    constants: Mapping[str, tuple[float, Unit]] = field(default_factory=dict)
    externs: frozenset[str] = frozenset()
    functions: Mapping[str, InterfaceFunction] = field(default_factory=dict)
    path: str = ""
    places: Mapping[str, Span] = field(default_factory=dict)
    unread: Mapping[str, str] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """Path of the system file, or the name of the system if the path is unknown; for messages."""
        return self.path or self.name
