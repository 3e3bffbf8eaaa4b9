"""Signals that requirements read: how to read them from a file, and how to evaluate them.

The evaluator reads each signal as a column, an array `(time, batch)`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns as columns_of
from stlc.compile.ir.traverse import numbers, subexpressions
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.escape import visible
from stlc.grammar import ast
from stlc.registry import closest
from stlc.signature import Column, Kind
from stlc.source import Span
from stlc.trace import AS_IT_IS, Reading, Trace
from stlc.trace.enums import TRUTH, Words
from stlc.trace.recording import conversion

Given: TypeAlias = Mapping[str, Any]
"""Signal -> array (time,) or (…, time); a vector is (…, time, k)."""

CLOCK = "t"
"""Name under which a trace also offers its time in seconds."""

UNNAMED = "the signals"

_COMPONENT = re.compile(r"(?P<name>.+)\[(?P<index>\d+)\]")
_KINDS: Mapping[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


# ------------------------------------------------------------------ signals that are read


@dataclass(frozen=True, slots=True)
class Need:
    """Signal that requirements read.

    Attributes:
        column: name, unit and kind of the signal, as the specification declares them.
        by: names of the requirements that read the signal.
        span: source location of its declaration.
        parameter: whether the signal is a `param`, for which a constant value may be given instead.
    """

    column: Column
    by: tuple[str, ...]
    span: Span | None = None
    parameter: bool = False


def needs_of(compiled: Compiled, rules: Sequence[CompiledRequirement]) -> tuple[Need, ...]:
    """Return the signals that the requirements `rules` read, in the order of the specification.

    Raises:
        UsageError: E107, the requirements call functions that are not loaded.
    """
    _require_functions(compiled, rules)
    read = [(rule.name, columns_of(rule.formula)) for rule in rules]
    spans = {
        item.name: item.name_span for item in compiled.spec.items if isinstance(item, (ast.Signal, ast.Param))
    }
    parameters = {each.column.name for each in compiled.typed.parameters}
    found = []
    for column in compiled.signature.columns:
        if by := tuple(rule for rule, names in read if column.name in names):
            base = match["name"] if (match := _COMPONENT.fullmatch(column.name)) else column.name
            found.append(Need(column, by, spans.get(base), column.name in parameters))
    return tuple(found)


def _require_functions(compiled: Compiled, rules: Sequence[CompiledRequirement]) -> None:
    parts = (part for rule in rules for num in numbers(rule.formula) for part in subexpressions(num))
    missing = dict.fromkeys(
        part.name for part in parts if isinstance(part, ir.Extern) and part.function is None
    )
    if not missing:
        return
    places = {item.name: item.name_span for item in compiled.spec.items if isinstance(item, ast.Extern)}
    help_ = ("--system FILE names the system that does; its functions are Python code, and loading runs it",)
    message = "`{}` is a function from outside, and nobody provides it here"
    raise UsageError(*(Diagnostic("E107", message.format(n), places.get(n), help=help_) for n in missing))


def reading_of(spec: ast.Spec, requested: Reading = AS_IT_IS) -> Reading:
    """Return the options `requested`, completed by the kinds and words of the declared signals.

    Args:
        spec: the specification, which declares the signals. It gives their kinds (such as bool or enum), and
            the numbers that words (members of an enum) stand for.
        requested: options of the user: the time grid, and the names that signals have in the file. The key of
            such a name is the signal, or the text after `from` in the declaration of the signal.
    """
    signals = [item for item in spec.items if isinstance(item, ast.Signal)]
    columns = {item.name: item.column for item in signals if item.column}

    def column(name: str) -> str:
        """Return the name that a signal has in the file.

        Example: after the declaration `p from "q"`, the vector component `p[0]` is called `q[0]` in the file.
        """
        base, bracket, index = name.partition("[")
        return columns.get(name) or f"{columns.get(base, base)}{bracket}{index}"

    worth: dict[str, Words] = {"bool": TRUTH}
    worth |= {item.name: dict(item.members) for item in spec.items if isinstance(item, ast.Enum)}
    kinds: dict[str, Kind] = {}
    words: dict[str, Words] = {}
    for item in signals:
        name = item.column or item.name
        words[name] = {} if item.type is None else worth.get(item.type.name, {})
        if item.type is not None:
            kinds[name] = _KINDS.get(item.type.name, "enum")
    names = {column(name): there for name, there in requested.names.items()}
    return replace(requested, names=names, kinds=kinds, words=words)


# ------------------------------------------------------------------------------- columns


@dataclass(frozen=True, slots=True)
class Signals:
    """Signals as arrays for the evaluator.

    Attributes:
        env: signal name -> array (time, batch).
        shape: axes of the signals before the time axis: () for a single trace.
        samples: length of the time axis.
        ops: the array library.
        name: name of the trace, for messages.
        dt: time step in seconds; None if it is unknown.
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

    @property
    def gaps(self) -> dict[str, Gap]:
        """Unknown samples (NaN) of every signal that contains NaN, by name; {} if arrays are not NumPy."""
        if self.ops is not NUMPY:
            return {}
        found = {name: Gap().with_more(np.isnan(values)) for name, values in self.env.items()}
        return {name: gap for name, gap in found.items() if gap.samples}

    def like_given(self, values: Array) -> Array:
        """Reshape values (time, batch) to (…, time), the shape in which the signals were given."""
        return values.swapaxes(0, 1).reshape((*self.shape, len(values)))

    def at_one(self, values: Array) -> Array:
        """Reshape values (1, batch) of one sample, with one entry per trace.

        The result has the shape that the signals were given in, without the time axis: (traces,) for signals
        (traces, samples), and a single number for signals (samples,).
        """
        flat = values.reshape(self.shape)
        return flat if self.shape or self.ops is not NUMPY else np.float64(flat)


def arrange(given: Given | Trace, needs: Sequence[Need], *, plain: bool = False) -> Signals:
    """Convert the signals that requirements need to arrays (time, batch).

    NaN is an unknown value. NumPy arrays and lists become float64. Torch tensors keep dtype, device and
    gradients; if `plain`, they become NumPy arrays.

    Raises:
        TraceError: E601, a signal is missing; E604, a signal contains infinity (NumPy only); E605, the shapes
            of arrays or the units do not fit together.
    """
    trace = given if isinstance(given, Trace) else None
    name = UNNAMED if trace is None else trace.name
    data: Given = given if not isinstance(given, Trace) else {CLOCK: given.times, **given.data}
    found = {need.column.name: _find(data, need.column.name) for need in needs}
    there = data if trace is None else {**data, **trace.extras}
    missing = [_missing(need, there, name) for need in needs if found[need.column.name] is None]
    if missing:
        raise TraceError(*missing)
    if not found:  # the numbers of traces and samples are those of any signal, preferably not of a vector
        any_one = min(data, key=lambda key: (key == CLOCK, np.ndim(data[key])), default=None)
        found = {} if any_one is None else {any_one: _find(data, any_one)}
    torch = sys.modules.get("torch")  # not imported to find out
    tensors = [] if torch is None else [key for key, x in found.items() if isinstance(x, torch.Tensor)]
    if tensors and plain:
        found |= {key: found[key].detach().cpu().numpy() for key in tensors}
        tensors = []
    shape, samples = _common_shape(found, name)
    if tensors:
        from stlc.compile.backends.torch.ops import TORCH

        given_tensors = [found[key] for key in tensors]
        return Signals(_torch_columns(found, given_tensors, (*shape, samples)), shape, samples, TORCH, name)
    columns = {key: _numpy_column(values, (*shape, samples)) for key, values in found.items()}
    signals = Signals(columns, shape, samples, NUMPY, name)
    if trace is not None:
        columns = _in_units(columns, needs, trace)
        signals = Signals(columns, (trace.traces,), samples, NUMPY, name, trace.dt, trace.t0)
    _check_finite(signals, needs)
    return signals


def _find(data: Given, name: str) -> Any:
    """Return the array called `name`; None if there is none.

    A component such as `q[0]` is also found in the vector `q`.
    """
    index = None
    if name not in data:
        match = _COMPONENT.fullmatch(name)
        if match is None or match["name"] not in data:
            return None
        name, index = match["name"], int(match["index"])
    values = data[name] if hasattr(data[name], "shape") else np.asarray(data[name], dtype=np.float64)
    if index is None:
        return values
    return values[..., index] if values.ndim >= 2 and index < values.shape[-1] else None


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
    """Return the shape of the arrays without their time axis, and their number of samples.

    An array that is a single number is a constant signal.
    """
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


def _numpy_column(values: Any, shape: tuple[int, ...]) -> Array:
    full = np.broadcast_to(np.asarray(values, dtype=np.float64), shape)
    return np.ascontiguousarray(full.reshape(-1, shape[-1]).T)


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
    """Convert signals from the units in the trace to those that the specification declares.

    A signal with an unknown unit is unchanged.

    Raises TraceError (E605) if two units measure different quantities.
    """
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
    """Finding E604: a signal has the infinite value `value`; `where` is its instant as text."""
    return Diagnostic(
        "E604",
        f"{signal} is {value} at {where}",
        help=("leave the cell empty where nothing was measured: then what needs it is inconclusive",),
        note=(f"needed by: {', '.join(need.by)}",),
    )


@dataclass(frozen=True, slots=True)
class Gap:
    """Count and range of the unknown samples (NaN) of a signal.

    Attributes:
        samples: number of unknown samples, over all traces.
        first: index of the first unknown sample.
        last: index of the last unknown sample.
    """

    samples: int = 0
    first: int = 0
    last: int = 0

    def with_more(self, unknown: NDArray[np.bool_], offset: int = 0) -> Gap:
        """Return a gap that also includes the unknown samples of further data.

        The array `unknown`, (samples,) or (samples, traces), is True at these samples. `offset` is the index
        in the trace of the first row of `unknown`.
        """
        rows = np.flatnonzero(unknown.reshape(len(unknown), -1).any(axis=1))
        if not len(rows):
            return self
        first = self.first if self.samples else offset + int(rows[0])
        return Gap(self.samples + int(np.count_nonzero(unknown)), first, offset + int(rows[-1]))


def gap_text(name: str, gap: Gap, samples: int, moments: tuple[str, str]) -> str:
    """Return in words which samples of a signal are unknown: `… at 2 of 60 samples (t = 8 s to 9 s)`."""
    first, last = moments
    where = first if gap.samples == 1 else f"{first} to {last.removeprefix('t = ')}"
    return f"`{visible(name)}` is unknown at {gap.samples:,} of {samples:,} samples ({where})"
