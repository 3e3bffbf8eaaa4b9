"""Arrays by name as they come from a file, made into arrays of signals; formats of arrays share this."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic
from stlc.trace.formats.registry import MAX_LETTERS
from stlc.trace.recording import ClockGroup, Recording, Wanted

Array = NDArray[Any]

MAX_OTHERS = 10_000
"""Most names of a file that are remembered for messages."""


@dataclass(slots=True)
class Arrays:
    """Collection of the arrays of a file that are kept; see `Recording` for the meaning of the attributes."""

    wanted: Wanted
    kept: dict[str, Array] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    clashes: dict[str, dict[str, str]] = field(default_factory=dict)
    others: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def recording(self, path: Path, groups: Iterable[ClockGroup] = (), **more: Any) -> Recording:
        """Return all that was found; without `groups`, the arrays that are kept are a group."""
        return Recording(
            str(path),
            tuple(groups) or (ClockGroup(self.kept, None),),
            units={name: unit for name, unit in self.units.items() if unit},
            others=tuple(self.others),
            clashes=self.clashes,
            refused=self.refused,
            remarks=tuple(Diagnostic("W305", remark) for remark in self.remarks),
            **more,
        )

    def takes(self, name: str, part_of: str = "") -> bool:
        """True if the array `name`, or a part of it, is kept; otherwise `name` is noted among the others.

        `part_of` is the array to which it belongs as a component or a field.
        """
        if self.wanted.keeps(name) or part_of in (self.wanted.names or ()):
            return True
        self.note(name)
        return False

    def note(self, name: str) -> None:
        """Note a name that is left out."""
        if len(self.others) < MAX_OTHERS:
            self.others.append(name)

    def add(self, name: str, values: Array, *, piece: bool = False) -> None:
        """Add an array. If only one axis is longer than 1 it becomes (samples,), except in a piece.

        The fields of structured values are called `name.field`. Durations become seconds, dates have the
        dtype `M8[ns]`. Values of other kinds are refused.
        """
        if values.dtype.names is not None:
            for part in values.dtype.names:
                if self.takes(f"{name}.{part}", name):
                    self.add(f"{name}.{part}", values[part], piece=piece)
            return
        made = _plain(values)
        if isinstance(made, str):
            self.refuse(name, made)
            return
        if not piece and made.ndim > 1 and sum(length != 1 for length in made.shape) <= 1:
            made = made.reshape(-1)
        self.kept[name] = made
        if made.ndim == 1 and f"{name}[0]" in (self.wanted.names or ()):
            self.kept[f"{name}[0]"] = made

    def refuse(self, name: str, why: str) -> None:
        """Note that an array, and everything wanted that belongs to it, has no values."""
        below = (f"{name}.", f"{name}[")
        parts = [each for each in self.wanted.names or () if each.startswith(below)]
        self.refused |= dict.fromkeys([name, *parts], why)


def _plain(values: Array) -> Array | str:
    kind, one = values.dtype.kind, np.datetime_data(values.dtype)[0] if values.dtype.kind in "mM" else ""
    if kind == "c":
        why = "holds complex numbers: store their real and imaginary parts as two arrays"
        return why if values.imag.any() else _plain(values.real)
    if kind == "f" and values.dtype.itemsize > 8:
        return values.astype(np.float64)
    if kind == "S":
        values = np.char.decode(values, "utf-8", "replace")
    if kind in "SU":
        return values.astype(f"U{MAX_LETTERS}") if values.dtype.itemsize > 4 * MAX_LETTERS else values
    if kind == "m" and one not in ("Y", "M", "generic"):
        return values / np.timedelta64(1, "s")
    if kind == "M" and one != "generic":
        dates = values.astype("M8[ns]")
        same = (dates.astype(values.dtype) == values) | np.isnat(values)
        return dates if same.all() else "holds dates too far off"
    return values if kind in "biuf" else f"holds `{values.dtype}`, not numbers"


def no_letters(codes: Array) -> NDArray[np.bool_]:
    """True where a code is no letter: one behind the last of Unicode, or a half of a pair."""
    return (codes > 0x10FFFF) | ((codes >= 0xD800) & (codes <= 0xDFFF))
