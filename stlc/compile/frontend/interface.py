"""Interface of a system: the facts that the compiler knows without loading it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from stlc.compile.ir.nodes import Body
from stlc.signature import Signature
from stlc.source import Span
from stlc.units import Unit


class Function(Protocol):
    """A function from outside, such as forward kinematics."""

    def bound(
        self, arguments: tuple[int | None, ...], result: int | None
    ) -> Callable[..., Sequence[Any]] | Body:
        """The function on components.

        Args:
            arguments: the size of each vector that it takes; None for a number.
            result: the size of the vector that it gives; None for a number.

        Returns:
            Takes all components as arrays that broadcast, and gives the components of the result; or what
            these are in the IR.
        """


@dataclass(frozen=True, slots=True)
class Interface:
    """States, constants and functions that a system offers to a specification.

    Attributes:
        name: of the system.
        signature: its states, in order, with the units that are stored.
        constants: name -> (value in SI units, unit).
        externs: names of the functions that the system provides.
        functions: those that have been loaded, by name.
        path: of the system file, as messages show it.
        places: name of a state or constant -> where the system file declares it.
    """

    name: str
    signature: Signature
    constants: Mapping[str, tuple[float, Unit]] = field(default_factory=dict)
    externs: frozenset[str] = frozenset()
    functions: Mapping[str, Function] = field(default_factory=dict)
    path: str = ""
    places: Mapping[str, Span] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """Name in messages: the path of its file, else its name."""
        return self.path or self.name
