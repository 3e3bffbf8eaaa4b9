"""Initial states that are known: the points of a grid, or what lies in a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from stlc.diagnostics import Diagnostic, StlcError, SystemFileError
from stlc.dynamics.declaration.init import FileDecl, GridDecl
from stlc.dynamics.init.draws import Rows
from stlc.trace import load_trace
from stlc.trace.formats.npz import read_npz

SHUFFLED = 1 << 20
"""Up to so many points every one comes equally often; beyond, every axis is picked for itself."""


class Points(Protocol):
    """States that are known."""

    def __call__(self, rows: Rows) -> dict[str, Tensor]:
        """One of them for every row, (count,) float64 by name."""


def points_of(decl: GridDecl | FileDecl) -> Points:
    """What a declaration names. A file is read when the first state is asked for."""
    return _Grid(decl) if isinstance(decl, GridDecl) else _File(decl)


class _Grid:
    """Combinations by number, the last axis fastest; they are never written out."""

    def __init__(self, decl: GridDecl) -> None:
        self._axes = [(name, torch.tensor(values, dtype=torch.float64)) for name, values in decl.axes]
        self._count = math.prod(len(values) for _, values in self._axes)

    def __call__(self, rows: Rows) -> dict[str, Tensor]:
        if self._count > SHUFFLED:
            return {
                name: values.to(rows.generator.device)[_picked(len(values), rows)]
                for name, values in self._axes
            }
        number = _picked(self._count, rows)
        found: dict[str, Tensor] = {}
        for name, values in reversed(self._axes):
            found[name] = values.to(number.device)[number % len(values)]
            number = number // len(values)
        return found


class _File:
    """Rows of a file."""

    def __init__(self, decl: FileDecl) -> None:
        self._decl = decl
        self._columns: dict[str, Tensor] = {}

    def __call__(self, rows: Rows) -> dict[str, Tensor]:
        """Raises SystemFileError (S303) where the file does not hold the states."""
        if not self._columns:
            self._columns = self._read()
        first = next(iter(self._columns.values()))
        number = _picked(len(first), rows)
        return {name: column.to(number.device)[number] for name, column in self._columns.items()}

    def _read(self) -> dict[str, Tensor]:
        path = self._decl.path
        try:
            arrays = read_npz(path) if path.suffix == ".npz" else load_trace(path).data
        except StlcError as error:
            raise self._refused(error.diagnostics[0].message) from None
        found = {name: _column(name, arrays) for name in self._decl.names}
        missing = [name for name, column in found.items() if column is None]
        if missing:
            listed = ", ".join(f"`{name}`" for name in missing)
            raise self._refused(f"`{path}` has no {listed}", f"it holds {', '.join(arrays)}")
        columns = {name: torch.from_numpy(column) for name, column in found.items() if column is not None}
        sizes = {len(column) for column in columns.values()}
        if len(sizes) > 1 or 0 in sizes:
            counts = ", ".join(f"`{name}` {len(column)}" for name, column in columns.items())
            raise self._refused(f"`{path}` does not hold as many values for every state", counts)
        bad = [name for name, column in columns.items() if not bool(torch.isfinite(column).all())]
        if bad:
            raise self._refused(f"`{path}` holds NaN or infinity in `{bad[0]}`")
        return columns

    def _refused(self, message: str, note: str = "") -> SystemFileError:
        notes = (note,) if note else ()
        return SystemFileError(Diagnostic("S303", message, self._decl.span, "named here", note=notes))


def _column(name: str, arrays: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """All samples of a column, (count,); a component of a vector may be a slice of its last axis."""
    base, bracket, index = name.partition("[")
    values = arrays.get(name)
    if values is None and bracket and base in arrays and arrays[base].ndim:
        component = int(index.rstrip("]"))
        whole = arrays[base]
        values = whole[..., component] if component < whole.shape[-1] else None
    if values is None or values.dtype.kind not in "biuf":
        return None
    return values.astype(np.float64).ravel()


def _picked(count: int, rows: Rows) -> Tensor:
    """Numbers below `count`, (rows,): every one as often as the others, in random order."""
    generator, device = rows.generator, rows.generator.device
    rounds = -(-rows.count // count)
    orders = [torch.randperm(count, generator=generator, device=device) for _ in range(rounds)]
    return torch.cat(orders)[: rows.count] if orders else torch.zeros(0, dtype=torch.int64, device=device)
