"""Signals as Python programs give them: arrays, lists of words, masked arrays, frames of pandas or polars."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext, suppress
from itertools import filterfalse
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import TraceError
from stlc.trace import Reading, Trace, trace_of
from stlc.trace.clocks import ClockSetting, clocked
from stlc.trace.enums import Words, in_numbers
from stlc.trace.recording import ClockGroup, Recording, clock_rank
from stlc.trace.time_grid import read_clock

Given: TypeAlias = Mapping[str, Any]
"""Signal -> array (time,) or (…, time); a vector is (…, time, k)."""

UNNAMED = "the signals"
_ARRAYS = "give an array of numbers, of truth values, or of the words of an enum"
CLOCKS = ("time", "t")
"""Keys that hold the times, unless a requirement reads them."""


def is_frame(given: object) -> bool:
    """True for a data frame of pandas or polars."""
    return hasattr(given, "columns") and hasattr(given, "dtypes") and not isinstance(given, Mapping)


def trace_of_table(given: Any, reading: Reading) -> Trace:
    """Return the trace in a data frame or in arrays by name; the clock is a column, or the index of a frame.

    Raises TraceError with the errors of `stlc.trace.trace_of`.
    """
    arrays: dict[str, NDArray[Any]] = {}
    for key in given if isinstance(given, Mapping) else given.columns:
        name = str(key)
        if reading.wanted.keeps(name):
            with nullcontext() if reading.wanted.reads(name) else suppress(TraceError):
                arrays[name] = _flat(name, given[key])
    index = getattr(given, "index", None)
    name = str(getattr(index, "name", None) or "")
    if clock_rank(name) == 2 or getattr(index, "dtype", np.dtype("i8")).kind in "mM":
        arrays.setdefault(name or "time", _flat("index", index))
    return trace_of(
        Recording(UNNAMED if isinstance(given, Mapping) else "the frame", (ClockGroup(arrays, None),)),
        reading,
    )


def plain(given: Given, reading: Reading) -> tuple[dict[str, Any], float | None]:
    """Return signals as arrays of numbers, and their time step in seconds if they come with times.

    Masked samples are NaN, words are the numbers that they stand for, and (n, 1) is a column of n samples.

    Raises:
        TraceError: E602, the times are not uniform; E603, an array of complex numbers, of objects, or
            of words that the signal does not have.
    """
    found: dict[str, Any] = {}
    read = reading.read or {}
    others = [name for name in given if name not in read and name not in CLOCKS] if read else []
    unread = set(filterfalse(reading.wanted.reads, others)) if others else ()
    for name, values in given.items():
        try:
            made = values if hasattr(values, "requires_grad") else _flat(name, values)
        except TraceError:
            if name not in unread:
                raise
            continue
        if name in unread and isinstance(made, np.ndarray) and made.dtype.kind in "UcMm":
            continue
        found[name] = made.reshape(-1) if made.ndim == 2 and made.shape[1] == 1 < made.shape[0] else made
    clock = next((key for key in CLOCKS if key in found and key not in read), None)
    step = None if clock is None else _step(clock, found.pop(clock))
    texts = {name: x for name, x in found.items() if isinstance(x, np.ndarray) and x.dtype.kind in "UcMm"}
    if texts:
        known: dict[str, Words] = {name: (reading.words or {}).get(name, {}) for name in texts}
        found |= in_numbers(Recording(UNNAMED, (ClockGroup(texts, None),)), known).groups[0].arrays
    return found, step


def _step(name: str, values: Any) -> float | None:
    """Time step of the times under the key `name`; None for a single one."""
    times = values.detach().cpu().numpy() if hasattr(values, "requires_grad") else values
    rows = times.reshape(-1, times.shape[-1]) if times.ndim else times.reshape(1, 1)
    if (rows != rows[0]).any():
        raise _refused(name, "holds other times for each trace")
    group = ClockGroup({name: rows[0], "": np.zeros(len(rows[0]))}, None)
    (found,) = clocked(Recording(UNNAMED, (group,)), ClockSetting(name), {"": False}).groups
    if found.clock is None:
        raise _refused(name, "holds no times")
    return None if len(rows[0]) < 2 else read_clock(UNNAMED, found.clock, None, len(rows[0]))[1]


def _flat(name: str, values: Any) -> NDArray[Any]:
    """Return an array of numbers, texts or dates. Raises TraceError (E603) for other objects."""
    if isinstance(values, np.ndarray) and hasattr(values, "filled"):  # masked; `np.ma` itself loads slowly
        is_number = values.dtype.kind in "biuf"
        masked: Any = values.astype(np.float64) if is_number else values
        values = masked.filled(np.nan if is_number else "")
    try:
        array = np.asarray(values)
    except ValueError:
        raise _refused(name, "holds rows of different lengths") from None
    if array.dtype.kind == "O":
        array = _of_objects(name, array)
    if array.dtype.kind not in "biufUcMm":
        raise _refused(name, f"holds `{array.dtype}`")
    return array


def numbers_in(name: str, values: Any) -> NDArray[np.float64]:
    """Return the array of the numbers in a list. Raises TraceError (E603) for other things in it."""
    array = _flat(name, values)
    if array.dtype.kind in "UcMm":
        raise _refused(name, "holds texts, and only numbers can be taken here", "give numbers")
    return array.astype(np.float64)


def _of_objects(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return the texts or numbers in an array of objects, such as a column of pandas."""
    missing = np.asarray(np.frompyfunc(_is_missing, 1, 1)(array), dtype=bool)
    there = array[~missing].tolist()
    if there and all(isinstance(each, str) for each in there):
        return np.where(missing, "", array).astype(str)
    if all(isinstance(each, (bool, int, float, np.number, np.bool_)) for each in there):
        try:
            return np.where(missing, np.nan, array).astype(np.float64)
        except OverflowError:
            raise _refused(name, "holds an integer beyond the range of floats") from None
    raise _refused(name, f"holds Python objects (`{type(there[0]).__name__}`)")


def _is_missing(value: object) -> bool:
    """True for None, NaN, and the missing values of pandas, which cannot be compared."""
    is_nan = isinstance(value, (float, np.floating)) and value != value
    return value is None or is_nan or type(value).__name__ in ("NAType", "NaTType")


def _refused(name: str, what: str, advice: str = _ARRAYS) -> TraceError:
    return TraceError.of("E603", f"`{name}` of {UNNAMED} {what}", help=(advice,))
