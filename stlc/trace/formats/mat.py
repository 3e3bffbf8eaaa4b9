"""Variables in a MATLAB `.mat` file; files of version 7.3 are HDF5 and need the extra `mat`.

Numeric and logical arrays are signals; `t` is the time. The field `x` of a structure `s` is called `s.x`, and
the columns of a matrix (samples, k) are the components of a vector. Texts, cell arrays and objects are left
out. Complex numbers are not signals: it is an error to request one as a signal.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.trace.formats.mat5 import complex_of, read_mat5
from stlc.trace.formats.npz import MAX_ARRAYS
from stlc.trace.formats.registry import MAX_BYTES, damage, needed, opened, room_for, unreadable
from stlc.trace.recording import Recording, of_arrays

Array = NDArray[Any]

_HDF5 = b"\x89HDF\r\n\x1a\n"
_COMPLEX = ("real", "imag")
_RATIO = 1100
"""Limit on the compression ratio: more than deflate can reach."""


def read(path: Path) -> Recording:
    """Return the numeric variables of a `.mat` file.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        MissingError: R301, version 7.3 needs `h5py`.
        TraceError: E603, the file is of another format, damaged, or larger than the limit.
    """
    with opened(path), path.open("rb") as file:
        head = file.read(520)
    if path.stat().st_size > MAX_BYTES:
        raise unreadable(path, f"it is larger than {MAX_BYTES / 1e9:.0f} GB", advice="split it")
    if _HDF5 in (head[:8], head[512:520]):
        arrays = _read_hdf5(path)
    elif head[126:128] in (b"IM", b"MI"):
        arrays = read_mat5(path)
    else:
        what = "it is empty" if not head else "it is not a MATLAB file of version 5 or 7.3"
        raise unreadable(path, what, advice="save it in MATLAB with  save FILE -v7")
    if not arrays:
        raise unreadable(path, "it holds no array of numbers")
    return of_arrays(path, {name: _as_signal(values) for name, values in arrays.items()})


def _as_signal(values: Array) -> Array:
    """Return the array; a matrix with a single row or column is flattened to (samples,)."""
    if values.ndim == 2 and 1 in values.shape:
        return values.reshape(-1)
    return values


# ---------------------------------------------------------------------- version 7.3


def _read_hdf5(path: Path) -> dict[str, Array]:
    h5py = needed("h5py")
    found: dict[str, Array] = {}
    room = room_for(path)
    with damage(path), h5py.File(path, "r") as file:
        for name, dataset in _datasets(path, file, "", 0):
            size = int(np.prod(dataset.shape, dtype=np.float64)) * dataset.dtype.itemsize
            if size > room or size > _RATIO * dataset.id.get_storage_size() + 1024:
                raise unreadable(path, f"`{name}` declares {size / 1e9:.3g} GB that the file does not hold")
            room -= size
            found[name] = _real(np.asarray(dataset[()]).T)
    return found


def _real(values: Array) -> Array:
    """Convert structured values with a real and an imaginary part to complex numbers.

    If all imaginary parts are 0, the real parts are returned. Other values are returned unchanged.
    """
    if values.dtype.names is None:
        return values
    real, turned = (values[part] for part in _COMPLEX)
    return complex_of(real, turned) if turned.any() else real


def _datasets(path: Path, group: Any, prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
    """Yield (name, dataset) for every numeric dataset in `group` and in the groups inside it.

    Links are not followed. `prefix` is put before every name, and `depth` is the nesting depth of `group`.

    Raises:
        TraceError: E603, the file is nested too deeply or contains too many arrays.
    """
    h5py = needed("h5py")
    if depth > 8 or len(group) > MAX_ARRAYS:
        raise unreadable(path, "it is nested too deeply, or holds too many arrays")
    for name in group:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from _datasets(path, item, f"{prefix}{name}.", depth + 1)
        elif isinstance(item, h5py.Dataset) and _plain(item):
            yield prefix + name, item


def _plain(dataset: Any) -> bool:
    kind = dataset.attrs.get("MATLAB_class", b"double")
    numeric = dataset.dtype.kind in "biuf" or dataset.dtype.names == _COMPLEX
    is_numbers = numeric and kind not in (b"char", b"cell", b"function_handle")
    empty = dataset.attrs.get("MATLAB_empty", 0)
    return bool(is_numbers and not empty and not dataset.is_virtual and not dataset.external)
