"""Conversion of given signals to columns `(time, batch)` for the evaluator."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.diagnostics import Diagnostic, TraceError
from stlc.monitor.needs import Need
from stlc.registry import closest
from stlc.signature import Column
from stlc.source import Span
from stlc.trace import Trace
from stlc.units import SYMBOLS, Unit, same_dims

Given: TypeAlias = Mapping[str, Any]
"""Signal -> array (time,) or (…, time); a vector is (…, time, k)."""

CLOCK = "t"
"""Name under which a trace also offers its time in seconds."""

UNNAMED = "the signals"

_COMPONENT = re.compile(r"(?P<name>.+)\[(?P<index>\d+)\]")


@dataclass(frozen=True, slots=True)
class Signals:
    """Columns laid out for the evaluator.

    Attributes:
        env: name -> (time, batch).
        shape: leading axes before the time axis: () for a single trace.
        samples: length of the time axis.
        ops: the library of the arrays.
        name: of the trace, for messages.
        dt: time step in seconds, where the signals come with one.
        t0: time of the first sample in seconds.
    """

    env: Mapping[str, Array]
    shape: tuple[int, ...]
    samples: int
    ops: Ops
    name: str = UNNAMED
    dt: float | None = None
    t0: float = 0.0

    @property
    def batch(self) -> int:
        """Number of traces."""
        return int(np.prod(self.shape, dtype=np.int64))

    def like_given(self, values: Array) -> Array:
        """Reshape (time, batch) to (…, time)."""
        return values.swapaxes(0, 1).reshape((*self.shape, len(values)))

    def at_one(self, values: Array) -> Array:
        """Reshape (1, batch) to (…)."""
        flat = values.reshape(self.shape)
        return flat if self.shape or self.ops is not NUMPY else np.float64(flat)


def arrange(given: Given | Trace, needs: Sequence[Need], *, plain: bool = False) -> Signals:
    """Lay out the signals that are needed.

    NaN is an unknown value. NumPy arrays and lists become float64; torch tensors keep dtype, device
    and gradients, or with `plain` become NumPy arrays too.

    Raises:
        TraceError: E601, a signal is missing; E604, one holds infinity (NumPy only);
            E605, arrays or units do not fit together.
    """
    name = given.name if isinstance(given, Trace) else UNNAMED
    data: Given = {CLOCK: given.times, **given.data} if isinstance(given, Trace) else given
    found = {need.column.name: _find(data, need.column.name) for need in needs}
    there = {**data, **given.extras} if isinstance(given, Trace) else data
    missing = [_missing(need, there, name) for need in needs if found[need.column.name] is None]
    if missing:
        raise TraceError(*missing)
    arrays = found or _any_one(data)
    tensors = _tensors(arrays)
    if tensors and plain:
        arrays = {key: _as_numpy(values) for key, values in arrays.items()}
        tensors = []
    shape, samples = _common_shape(arrays, name)
    if tensors:
        from stlc.compile.backends.torch.ops import TORCH

        return Signals(_torch_columns(arrays, tensors, (*shape, samples)), shape, samples, TORCH, name)
    columns = _numpy_columns(arrays, (*shape, samples))
    signals = Signals(columns, shape, samples, NUMPY, name)
    if isinstance(given, Trace):
        columns = _in_units(columns, needs, given)
        signals = Signals(columns, (given.traces,), samples, NUMPY, name, given.dt, given.t0)
    _check_finite(signals, needs)
    return signals


def _any_one(data: Given) -> dict[str, Any]:
    """A signal that gives the numbers of traces and samples where none is read, preferably not a vector."""
    names = sorted(data, key=lambda name: (name == CLOCK, np.ndim(data[name])))
    return {name: _find(data, name) for name in names[:1]}


def _tensors(arrays: Mapping[str, Any]) -> list[Any]:
    """The torch tensors among the arrays; torch is not imported to find out."""
    torch = sys.modules.get("torch")
    return [] if torch is None else [v for v in arrays.values() if isinstance(v, torch.Tensor)]


def _as_numpy(values: Any) -> Any:
    return values.detach().cpu().numpy() if _tensors({"": values}) else values


# -------------------------------------------------------------------- finding them


def _find(data: Given, name: str) -> Any:
    """The array of a signal; `q[0]` is also a component of a vector `q`."""
    if name in data:
        values = data[name]
        return values if hasattr(values, "shape") else np.asarray(values, dtype=np.float64)
    match = _COMPONENT.fullmatch(name)
    if match is None or match["name"] not in data:
        return None
    vector = data[match["name"]]
    vector = vector if hasattr(vector, "shape") else np.asarray(vector, dtype=np.float64)
    index = int(match["index"])
    return vector[..., index] if vector.ndim >= 2 and index < vector.shape[-1] else None


def _missing(need: Need, data: Given, name: str) -> Diagnostic:
    wanted = need.column.name
    near = closest(wanted, data)
    shapes = ", ".join(f"{key} {tuple(np.shape(values))}" for key, values in data.items())
    help_ = () if near is None else (f"did you mean `{near}`? map it with  --map {wanted}={near}",)
    if need.parameter:
        value = f"{need.column.low or 0:g}{need.column.unit}"
        either = "or " if help_ else ""
        advice = f"{either}give it one value for all traces:  --set {wanted.partition('[')[0]}={value}"
        help_ = (*help_, advice)
    return Diagnostic(
        "E601",
        f"trace `{name}` has no signal `{wanted}`" if name != UNNAMED else f"no signal `{wanted}` is given",
        need.span,
        label=f"needed by: {', '.join(need.by)}",
        help=help_,
        note=(f"arrays in {name}: {shapes}",),
    )


def _common_shape(arrays: Mapping[str, Any], name: str) -> tuple[tuple[int, ...], int]:
    """Leading shape and number of samples; a single number stands for a constant signal."""
    lengths = {key: int(values.shape[-1]) for key, values in arrays.items() if values.ndim}
    if not lengths:
        raise TraceError(Diagnostic("E605", f"{name}: no signal has a time axis"))
    first, samples = next(iter(lengths.items()))
    odd = [key for key, length in lengths.items() if length != samples]
    if odd:
        message = f"`{odd[0]}` has {lengths[odd[0]]} samples, `{first}` has {samples}"
        raise TraceError(Diagnostic("E605", f"{name}: {message}"))
    if not samples:
        raise TraceError(Diagnostic("E605", f"{name}: the signals hold no samples"))
    try:
        shape = np.broadcast_shapes(*(tuple(values.shape[:-1]) for values in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{key} {tuple(values.shape)}" for key, values in arrays.items())
        raise TraceError(Diagnostic("E605", f"{name}: the arrays do not fit together: {shapes}")) from None
    if 0 in shape:
        raise TraceError(Diagnostic("E605", f"{name}: the arrays hold no traces"))
    return shape, samples


# ------------------------------------------------------------------ laying them out


def _numpy_columns(arrays: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, Array]:
    def column(values: Any) -> Array:
        full = np.broadcast_to(np.asarray(values, dtype=np.float64), shape)
        return np.ascontiguousarray(full.reshape(-1, shape[-1]).T)

    return {name: column(values) for name, values in arrays.items()}


def _torch_columns(
    arrays: Mapping[str, Any], tensors: Sequence[Any], shape: tuple[int, ...]
) -> dict[str, Array]:
    torch = sys.modules["torch"]
    floating = [tensor.dtype for tensor in tensors if tensor.is_floating_point()]
    dtype = floating[0] if floating else torch.get_default_dtype()
    for other in floating[1:]:
        dtype = torch.promote_types(dtype, other)

    def column(values: Any) -> Array:
        full = torch.as_tensor(values, dtype=dtype, device=tensors[0].device).broadcast_to(shape)
        return full.reshape(-1, shape[-1]).T

    return {name: column(values) for name, values in arrays.items()}


def _in_units(columns: Mapping[str, Array], needs: Sequence[Need], trace: Trace) -> dict[str, Array]:
    """Numbers in the units that the specification declares, where both units are known."""
    converted = dict(columns)
    findings: list[Diagnostic] = []
    for need in needs:
        name = need.column.name
        if name not in trace.signature:
            continue
        try:
            change = conversion(trace.name, need.column, trace.signature[name].unit, need.span)
        except TraceError as error:
            findings += error.diagnostics
            continue
        if change is not None:
            converted[name] = change(converted[name])
    if findings:
        raise TraceError(*findings)
    return converted


@dataclass(frozen=True, slots=True)
class Conversion:
    """Conversion between units: `x * factor + shift`."""

    factor: float
    shift: float

    def __call__(self, values: Any) -> Any:
        """The same values in the other unit."""
        scaled = values if self.factor == 1.0 else values * self.factor
        return scaled + self.shift if self.shift else scaled


def conversion(trace: str, column: Column, recorded: Unit, span: Span | None = None) -> Conversion | None:
    """Conversion of recorded numbers to the unit of a column; None where equal, or one unit is unknown.

    Raises:
        TraceError: E605, the quantities differ.
    """
    wanted = column.unit
    if not wanted.text or not recorded.text:
        return None
    if not same_dims(recorded, wanted):
        message = f"`{column.name}` is in [{recorded}] in `{trace}`, the specification declares [{wanted}]"
        coulombs = wanted.dims == SYMBOLS["K"].dims and recorded.text == "C"
        help_ = (f"[C] is coulombs: name the column `{column.name} [degC]`",) if coulombs else ()
        raise TraceError(Diagnostic("E605", message, span, help=help_))
    found = Conversion(
        float(recorded.ratio / wanted.ratio), float((recorded.offset - wanted.offset) / wanted.ratio)
    )
    return None if found == Conversion(1.0, 0.0) else found


def _check_finite(signals: Signals, needs: Sequence[Need]) -> None:
    findings = []
    for need in needs:
        bad = np.isinf(signals.env[need.column.name])
        if bad.any():
            sample = int(np.argmax(bad.any(axis=1)))
            trace = int(np.argmax(bad[sample]))
            value = signals.env[need.column.name][sample, trace]
            place = f"t = {signals.t0 + sample * signals.dt:.6g} s" if signals.dt else f"sample {sample}"
            where = f"trace {trace}, {place}" if signals.shape else place
            finding = not_finite(f"`{need.column.name}` in {signals.name}", value, where, need)
            findings.append(finding.with_note(f"{int(bad.sum())} of {bad.size} values are infinite"))
    if findings:
        raise TraceError(*findings)


def not_finite(signal: str, value: float, where: str, need: Need) -> Diagnostic:
    """E604 for an infinite value."""
    return Diagnostic(
        "E604",
        f"{signal} is {value} at {where}",
        help=("leave the cell empty where nothing was measured: then what needs it is inconclusive",),
        note=(f"needed by: {', '.join(need.by)}",),
    )


@dataclass(frozen=True, slots=True)
class Gap:
    """Unknown samples of a signal.

    Attributes:
        samples: how many, over all traces.
        first: the first of them.
        last: the last one.
    """

    samples: int = 0
    first: int = 0
    last: int = 0

    def with_more(self, unknown: NDArray[np.bool_], offset: int = 0) -> Gap:
        """The gap extended by unknown samples, (samples,) or (samples, traces), from sample `offset` on."""
        rows = np.flatnonzero(unknown.reshape(len(unknown), -1).any(axis=1))
        if not len(rows):
            return self
        first = self.first if self.samples else offset + int(rows[0])
        return Gap(self.samples + int(np.count_nonzero(unknown)), first, offset + int(rows[-1]))


def gaps_of(signals: Signals) -> dict[str, Gap]:
    """Gaps of the columns; for NumPy arrays only."""
    if signals.ops is not NUMPY:
        return {}
    found = {name: Gap().with_more(np.isnan(values)) for name, values in signals.env.items()}
    return {name: gap for name, gap in found.items() if gap.samples}
