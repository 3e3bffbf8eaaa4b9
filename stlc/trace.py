"""Recorded signals: a signature, a time step and arrays; `.npz` and `.csv` in and out, never a pickle.

An `.npz` trace holds `t` (samples,) in seconds, one array (samples,) or (traces, samples) per signal, arrays
`extra.NAME` of any shape, and `meta`, a JSON text that says what was recorded, with which specification.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.registry import closest
from stlc.signature import Column, Signature
from stlc.trace_csv import GROUPS, read_csv, write_csv
from stlc.trace_meta import TraceMeta, meta_array, read_meta
from stlc.trace_npz import read_npz, unreadable, write_npz
from stlc.trace_time import read_clock
from stlc.units import DIMENSIONLESS, Unit, parse_unit

__all__ = ["Trace", "TraceMeta", "as_fraction", "load_trace", "save_trace"]

Floats = NDArray[np.float64]

EXTRA = "extra."
RESERVED = ("t", "meta")


@dataclass(frozen=True, slots=True)
class Trace:
    """Signals of one or several agents on one uniform time grid.

    Attributes:
        signature: one column per signal, in the order of the file.
        dt: time step in seconds.
        data: signal -> (traces, samples), float64, in the units of the signature.
        t0: time of the first sample in seconds.
        extras: whatever else was recorded, any shape; never judged.
        meta: where it comes from.
        name: the path as the user gave it, for messages.
    """

    signature: Signature
    dt: float
    data: Mapping[str, Floats]
    t0: float = 0.0
    extras: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    meta: TraceMeta = field(default_factory=TraceMeta)
    name: str = "trace"

    @property
    def traces(self) -> int:
        """How many agents or repetitions."""
        return next((len(values) for values in self.data.values()), 0)

    @property
    def samples(self) -> int:
        """How many samples each has."""
        return next((values.shape[1] for values in self.data.values()), 0)

    @property
    def times(self) -> Floats:
        """Time of every sample in seconds, shape (samples,)."""
        return self.t0 + self.dt * np.arange(self.samples, dtype=np.float64)

    def renamed(self, names: Mapping[str, str]) -> Trace:
        """The same trace where signal `names[new]` is called `new`.

        Raises:
            TraceError: E601, a signal that is not in the trace.
        """
        findings = [self._absent(old) for old in names.values() if old not in self.data]
        if findings:
            raise TraceError(*findings)
        back = {old: new for new, old in names.items()}
        kept = [c for c in self.signature.columns if c.name in back or c.name not in names]
        columns = tuple(replace(c, name=back.get(c.name, c.name)) for c in kept)
        data = {back.get(c.name, c.name): self.data[c.name] for c in kept}
        return replace(self, signature=Signature(columns), data=data)

    def _absent(self, name: str) -> Diagnostic:
        near = closest(name, self.data)
        return Diagnostic(
            "E601",
            f"trace `{self.name}` has no signal `{name}`",
            help=(f"did you mean `{near}`?",) if near else (),
            note=(f"signals in {self.name}: {', '.join(self.data)}",),
        )


# ----------------------------------------------------------------------- reading


def load_trace(path: Path | str) -> Trace:
    """Read a trace; the format follows the suffix (`.csv`; everything else is `.npz`).

    Values may be NaN or infinite here: the monitor refuses them where a requirement needs them.

    Raises:
        UsageError: U102, no such file.
        TraceError: E601, no time; E602, time is not uniform; E603, the file cannot be read safely;
            E605, its arrays do not fit together.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        return _from_csv(path)
    return _from_npz(path)


def _from_npz(path: Path) -> Trace:
    arrays = read_npz(path)
    meta, columns = read_meta(path, arrays.pop("meta", None))
    extras = {name.removeprefix(EXTRA): arrays.pop(name) for name in list(arrays) if name.startswith(EXTRA)}
    texts = [name for name, values in arrays.items() if values.dtype.kind == "U"]
    if texts:
        raise unreadable(path, f"`{texts[0]}` holds text, not numbers")
    clock = arrays.pop("t", None)
    t0, dt, samples = read_clock(str(path), clock, meta.dt, _longest(arrays))
    data = _fit(str(path), arrays, samples)
    signature = Signature(tuple(columns.get(name, Column(name)) for name in data))
    return Trace(signature, dt, data, t0, extras, meta, str(path))


def _longest(arrays: Mapping[str, NDArray[Any]]) -> int:
    return max((values.shape[-1] for values in arrays.values() if values.ndim), default=0)


def _fit(name: str, arrays: Mapping[str, NDArray[Any]], samples: int) -> dict[str, Floats]:
    """Signals as (traces, samples); a third axis holds the components of a vector."""
    findings: list[Diagnostic] = []
    data: dict[str, NDArray[Any]] = {}
    for signal, values in arrays.items():
        if values.ndim in (1, 2) and values.shape[-1] == samples:
            data[signal] = np.atleast_2d(values)
        elif values.ndim in (2, 3) and values.shape[-2] == samples:
            stacked = values[None] if values.ndim == 2 else values
            data |= {f"{signal}[{i}]": stacked[..., i] for i in range(values.shape[-1])}
        else:
            shape = " x ".join(map(str, values.shape)) or "a single number"
            message = f"`{signal}` in `{name}` is {shape}, and `t` has {samples} samples"
            findings.append(
                Diagnostic("E605", message, help=("signals are (samples,) or (traces, samples)",))
            )
    traces = max((len(values) for values in data.values()), default=0)
    for signal, values in data.items():
        if len(values) not in (1, traces):
            message = f"`{signal}` in `{name}` has {len(values)} traces, other signals have {traces}"
            findings.append(Diagnostic("E605", message))
    if findings:
        raise TraceError(*findings)
    if not data:
        raise TraceError(Diagnostic("E601", f"trace `{name}` has no signals"))
    if not traces:
        raise TraceError(Diagnostic("E605", f"the arrays of `{name}` hold no traces"))
    return {
        signal: np.ascontiguousarray(np.broadcast_to(values, (traces, samples)), dtype=np.float64)
        for signal, values in data.items()
    }


def _from_csv(path: Path) -> Trace:
    table = read_csv(path)
    group = next((name for name in GROUPS if name in table.columns), None)
    columns = {name: values for name, values in table.columns.items() if name != group}
    keys = table.columns[group] if group else np.zeros(table.rows)
    labels, sizes = np.unique(keys, return_counts=True)
    if len(set(sizes.tolist())) > 1:
        i = int(np.argmax(sizes != sizes[0]))
        message = (
            f"traces in `{path}` differ in length: {group} {labels[0]:g} has {sizes[0]} samples, "
            f"{labels[i]:g} has {sizes[i]}"
        )
        raise TraceError(
            Diagnostic("E605", message, help=("put traces of other lengths into files of their own",))
        )
    order = np.argsort(keys, kind="stable").reshape(len(labels), -1)
    arrays = {name: values[order] for name, values in columns.items()}
    clock = arrays.pop("t", None)
    if clock is not None and not np.array_equal(
        clock, np.broadcast_to(clock[0], clock.shape), equal_nan=True
    ):
        raise TraceError(Diagnostic("E605", f"the traces in `{path}` were not sampled at the same times"))
    t0, dt, samples = read_clock(str(path), None if clock is None else clock[0], None, 0)
    data = _fit(str(path), arrays, samples)
    signature = Signature(tuple(Column(name, _unit(path, name, table.units[name])) for name in data))
    return Trace(signature, dt, data, t0, name=str(path))


def _unit(path: Path, name: str, text: str) -> Unit:
    try:
        return parse_unit(text) if text else DIMENSIONLESS
    except ValueError as error:
        raise TraceError(Diagnostic("E605", f"column `{name}` of `{path}`: {error}")) from None


# ----------------------------------------------------------------------- writing


def save_trace(path: Path | str, trace: Trace) -> None:
    """Write a trace; the format follows the suffix. A `.csv` holds the signals alone.

    Raises:
        TraceError: E605, a signal has a name that the format reserves.
        MissingError: R201, no room or no permission; an old file stays as it was.
    """
    taken = [name for name in trace.data if name in RESERVED or name.startswith(EXTRA)]
    if taken:
        raise TraceError(Diagnostic("E605", f"a recorded signal cannot be called `{taken[0]}`"))
    if Path(path).suffix.lower() == ".csv":
        _to_csv(path, trace)
        return
    arrays: dict[str, NDArray[Any]] = {"t": trace.times}
    arrays |= trace.data
    arrays |= {f"{EXTRA}{name}": np.asarray(values) for name, values in trace.extras.items()}
    arrays["meta"] = meta_array(replace(trace.meta, dt=trace.dt), trace.signature)
    write_npz(path, arrays)


def _to_csv(path: Path | str, trace: Trace) -> None:
    columns: dict[str, NDArray[Any]] = {"t": np.tile(trace.times, trace.traces)}
    if trace.traces > 1:
        columns = {GROUPS[0]: np.repeat(np.arange(trace.traces), trace.samples), **columns}
    columns |= {name: values.ravel() for name, values in trace.data.items()}
    write_csv(path, columns, {column.name: column.unit.text for column in trace.signature.columns})


def as_fraction(dt: float | Fraction) -> Fraction:
    """A time step as the fraction that was meant: 0.1 is 1/10, 0.0333… is 1/30."""
    near = Fraction(dt).limit_denominator(1_000_000)
    return near if near > 0 and abs(float(near) - float(dt)) <= 1e-9 * float(dt) else Fraction(dt)
