"""Interface of a system: the data that the compiler needs without loading it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from stlc.compile.ir.nodes import Body
from stlc.signature import Signature
from stlc.source import Span
from stlc.units import Unit


class InterfaceFunction(Protocol):
    """Function of the system, such as forward kinematics."""

    def bound(
        self, arguments: tuple[int | None, ...], result: int | None
    ) -> Callable[..., Sequence[Any]] | Body:
        """Return the function on components.

        Args:
            arguments: size of each vector argument; None for a number.
            result: size of the result; None for a number.

        Returns:
            Function from all components, as broadcastable arrays, to those of the result; or its body in the
            IR.
        """


@dataclass(frozen=True, slots=True)
class Interface:
    """States, constants and functions that a system provides to a specification.

    Attributes:
        name: of the system.
        signature: states in order, with stored units.
        constants: name -> (value in SI units, unit).
        externs: names of the functions that the system provides.
        functions: loaded functions, by name.
        path: of the system file, for messages.
        places: name of a state or constant -> its declaration in the system file.
    """

    name: str
    signature: Signature
    constants: Mapping[str, tuple[float, Unit]] = field(default_factory=dict)
    externs: frozenset[str] = frozenset()
    functions: Mapping[str, InterfaceFunction] = field(default_factory=dict)
    path: str = ""
    places: Mapping[str, Span] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """Name for messages: the path of the file, else the system's name."""
        return self.path or self.name
