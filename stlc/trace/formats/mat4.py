"""MATLAB's file format of version 4, and results of Modelica simulations in it (OpenModelica, Dymola)."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from stlc.trace.formats.arrays import Array, Arrays
from stlc.trace.formats.mat5 import Node, Variable, texts_of
from stlc.trace.recording import ClockGroup, Recording, Wanted
from stlc.units import Unit

_DTYPES = ("f8", "f4", "i4", "i2", "u2", "u1")
_HEAD = 20
_TEXT, _SPARSE = 1, 2
MAX_TABLES = 100
"""Most matrices `data_k` of a simulation."""
_UNIT = re.compile(r"\[([^\[\]|:]+)[^\[\]]*\]\s*$")


def mat4_kind(head: bytes) -> tuple[str, str, int] | None:
    """Byte order, dtype and kind of the matrix that begins with `head`; None if none of version 4 does."""
    for order, machine in (("<", 0), (">", 1)) if len(head) >= _HEAD else ():
        number = struct.unpack_from(f"{order}i", head)[0]
        rest, kind = divmod(number, 10)
        if 0 <= number < 5000 and rest // 10 == machine * 10 and rest % 10 < len(_DTYPES) and kind < 3:
            return order, order + _DTYPES[rest % 10], kind
    return None


def read_mat4(path: Path) -> Iterator[Variable]:
    """Yield the variables of a file. Raises ValueError for a damaged file."""
    raw = memoryview(np.memmap(path, np.uint8, mode="r"))  # type: ignore[arg-type]
    at = 0
    while at < len(raw):
        head = mat4_kind(bytes(raw[at : at + _HEAD]))
        if head is None:
            raise ValueError(f"no matrix begins at byte {at}")
        order, dtype, content = head
        rows, columns, imaginary, letters = struct.unpack_from(f"{order}4i", raw, at + 4)
        size = rows * columns * np.dtype(dtype).itemsize
        start = at + _HEAD + letters
        at = start + size * (2 if imaginary else 1)
        if min(rows, columns) < 0 or letters < 1 or at > len(raw):
            raise ValueError(f"{size} bytes are declared, {max(len(raw) - start, 0)} follow")
        turned = bool(imaginary) and np.frombuffer(raw[start + size : at], dtype).any()
        kind = "sparse" if content == _SPARSE else "complex" if turned else ""
        values = np.frombuffer(raw[start : start + size], dtype).reshape((rows, columns), order="F")
        name = bytes(raw[start - letters : start]).split(b"\0")[0].decode("latin-1")
        node = partial(Node, values.shape, values.view, text=content == _TEXT)
        yield Variable(name, False, partial(Node, kind=kind) if kind else node)


def modelica(path: Path, wanted: Wanted) -> Recording | None:
    """Return the variables of a simulation that are kept; None if the file holds no result of a simulation.

    A row of `dataInfo` tells for each name in which matrix `data_k` its values are, and in which column: a
    negative one for values with the opposite sign. The first column of a matrix is the time. Constants are
    in a matrix of their own.
    """
    matrices = {each.name: each.node() for each in islice(read_mat4(path), MAX_TABLES)}
    kind = matrices["Aclass"].values().tolist()
    if kind[0] != "Atrajectory" or len(kind) < 4:
        return None

    def table(name: str) -> Array:
        values = replace(matrices[name], text=False).values()
        return values.T if kind[3] == "binTrans" else values

    if "names" in matrices:  # plotted variables that Dymola exports: one matrix
        names = texts_of(table("names")).tolist()
        places, data = [[min(k, 1), k + 1] for k in range(len(names))], {1: table("data")}
    else:
        names, places = texts_of(table("name")).tolist(), table("dataInfo")[:, :2].astype(np.int64).tolist()
        data = {k: table(f"data_{k}") for k in range(1, MAX_TABLES) if f"data_{k}" in matrices}
    notes = texts_of(table("description")).tolist() if "description" in matrices else [""] * len(names)
    main = max(data, key=lambda k: len(data[k]))
    found, groups = Arrays(wanted), {k: dict[str, Array]() for k in data}
    for name, note, (k, column) in zip(names, notes, places, strict=True):
        if k == 0 or not wanted.reads(name):  # 0: the time
            found.note(name)
            continue
        if k not in data or not 1 <= abs(column) <= data[k].shape[1]:
            raise ValueError(f"`{name}` is in column {column} of `data_{k}`, which does not exist")
        values = data[k][:, abs(column) - 1].astype(np.float64) * (1 if column > 0 else -1)
        if k != main and (values == values[:1]).all():
            k, values = main, np.broadcast_to(values[:1], len(data[main]))
        groups[k][name], found.units[name] = values, ""
        if (unit := _UNIT.search(note)) is not None:
            with suppress(ValueError):
                found.units[name] = Unit.parse(unit[1].replace(".", "*").strip()).text
    times = {k: data[k][:, 0].astype(np.float64) for k, arrays in groups.items() if arrays or k == main}
    return found.recording(path, (ClockGroup(groups[k], clock, "time") for k, clock in times.items()))
