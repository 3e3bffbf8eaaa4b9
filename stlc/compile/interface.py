"""What the compiler may know of a system without loading it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

from stlc.signature import Signature
from stlc.source import Span
from stlc.units import Unit


@dataclass(frozen=True, slots=True)
class Grid:
    """The steps of time: `dt` in seconds, `horizon` (what `T` means) in steps; None where unknown."""

    dt: Fraction | None = None
    horizon: int | None = None


@dataclass(frozen=True, slots=True)
class Interface:
    """What a system offers to a specification.

    Attributes:
        name: of the system.
        signature: its states, in order, with the units that are stored.
        constants: name -> (value in SI units, unit).
        externs: name of a function that the system provides -> (length of its argument, of its result).
        path: of the system file, as messages show it.
        places: name of a state or constant -> where the system file declares it.
    """

    name: str
    signature: Signature
    constants: Mapping[str, tuple[float, Unit]] = field(default_factory=dict)
    externs: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    path: str = ""
    places: Mapping[str, Span] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """How messages call it: the path of its file, else its name."""
        return self.path or self.name
