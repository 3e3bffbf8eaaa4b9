"""Signals that requirements read: how to read them from a file, and how to evaluate them.

The evaluator reads each signal as a column, an array `(time, batch)`.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import islice
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.frontend.tags import BETWEEN, age_of
from stlc.compile.namespace import Array, Ops
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.escape import shell, visible
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.monitor.cells import Cells
from stlc.monitor.given import CLOCKS, UNNAMED, Given, numbers_in
from stlc.signature import Column, Kind
from stlc.similar import closest
from stlc.source import Span
from stlc.trace import AS_IT_IS, Reading, Trace
from stlc.trace.enums import Words
from stlc.trace.formats.table import GROUPS
from stlc.trace.recording import Conversion, conversion
from stlc.trace.resample import Between, How, Moments, TimeRange
from stlc.units import Unit

CLOCK = "t"
"""Name under which a trace also offers its time in seconds."""

_COMPONENT = re.compile(r"(?P<name>.+)\[(?P<index>\d+)\]")
_KINDS: Mapping[str, Kind] = {"real": "real", "int": "int", "bool": "bool"}


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

    Raises UsageError (E107) if the requirements call functions that are not loaded.
    """
    _require_functions(compiled, rules)
    read = [(rule.name, rule.formula.columns) for rule in rules]
    items = compiled.spec.read
    spans = {item.name: item.name_span for item in items}
    parameters = {each.column.name for each in compiled.typed.parameters}
    found = []
    for column in compiled.signature.columns:
        if by := tuple(rule for rule, names in read if column.name in names):
            span = spans.get(column.name.partition("[")[0])
            found.append(Need(column, by, span, column.name in parameters))
    return tuple(found)


def _require_functions(compiled: Compiled, rules: Sequence[CompiledRequirement]) -> None:
    calls = (call for rule in rules for call in rule.formula.calls())
    missing = dict.fromkeys(call.name for call in calls if call.function is None)
    if not missing:
        return
    places = {item.name: item.name_span for item in compiled.spec.functions}
    help_ = ("--system FILE names the system that does; its functions are Python code, and loading runs it",)
    message = "`{}` is a function from outside, and nobody provides it here"
    raise UsageError(*(Diagnostic("E107", message.format(n), places.get(n), help=help_) for n in missing))


def reading_of(spec: Spec, requested: Reading = AS_IT_IS, read: Collection[str] | None = None) -> Reading:
    """Return the options `requested`, completed by what the specification declares of its signals.

    Args:
        spec: the specification. It declares the kinds of signals, the numbers that words (members of an enum)
            stand for, and the values between samples (`@hold`, `@linear`, `@angle`).
        requested: options of the user, keyed by signals, or by the text after `from` in their declarations.
        read: names of the signals that requirements read, as compiled; None: all that the file holds.

    Raises UsageError (U101) if a name is that of no signal.
    """
    signals = spec.signals
    columns = {item.name: item.column for item in signals if item.column}

    def column(name: str) -> str:
        """Name in the file: declared as `p from "q"`, the component `p[0]` is called `q[0]` there."""
        base, bracket, index = name.partition("[")
        return columns.get(name) or f"{columns.get(base, base)}{bracket}{index}"

    worth: dict[str, Words] = {"bool": Column.TRUTH}
    worth |= {item.name: dict(item.members) for item in spec.enums}
    kinds: dict[str, Kind] = {}
    words: dict[str, Words] = {}
    between: dict[str, Between] = {}
    timelike: dict[str, bool] = {}
    for item in signals:
        name = item.column or item.name
        words[name] = {} if item.type is None else worth.get(item.type.name, {})
        kinds[name] = "real" if item.type is None else _KINDS.get(item.type.name, "enum")
        timelike[name] = not item.unit or Unit.written(item.unit).same_dims(Unit.SYMBOLS["s"])
        stated = next((tag for tag in item.tags if tag.name in BETWEEN), None)
        if stated is not None:  # by `@hold(0.5 s)`, for instance
            between[name] = _turned(Between(cast(How, stated.name), age_of(stated)), item)
    _require_signals(requested, spec, columns)
    declaration = {item.column or item.name: item for item in reversed(signals)}
    for name, each in requested.between.items():
        between[column(name)] = _turned(each, declaration.get(column(name)))
    names = {column(name): there for name, there in requested.names.items()}
    timely = None
    if read is not None:
        timely = {name: timelike.get(name.partition("[")[0], timelike.get(name, True)) for name in read}
    return replace(requested, names=names, kinds=kinds, words=words, between=between, read=timely)


def _require_signals(requested: Reading, spec: Spec, columns: Mapping[str, str]) -> None:
    """Raise UsageError (U101) if an option names a signal that the specification does not declare."""
    declared = [item.name for item in spec.read]
    known = {*declared, *columns.values(), CLOCK, *GROUPS}
    findings = []
    for option, names in (("--map", requested.names), ("--between", requested.between)):
        for name in names:
            if name not in known and name.partition("[")[0] not in known:
                note = (f"signals: {', '.join(declared)}",)
                message = f"`{option} {name}=…`: the specification has no signal `{name}`"
                findings.append(Diagnostic("U101", message, note=note).near(name, declared))
    if findings:
        raise UsageError(*findings)


def _turned(between: Between, item: ast.Signal | None) -> Between:
    """Values between samples with a full turn in the unit of the signal."""
    if between.how != "angle" or item is None or not item.unit:
        return between
    return replace(between, period=2.0 * math.pi / Unit.written(item.unit).scale)


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
        cells: recorded values between the samples, if the signals were resampled.
        spans: signal -> time in which it was seen, if the signals were resampled.
        times: time of each sample in seconds, where that differs from the grid; None if it does not.
        trace: the recording that the signals are of; None for signals of a Python program.
        first: index of the first sample, where only those that an instant reads were kept.
    """

    env: Mapping[str, Array]
    shape: tuple[int, ...]
    samples: int
    ops: Ops
    name: str = UNNAMED
    dt: float | None = None
    t0: float = 0.0
    cells: Cells | None = None
    spans: Mapping[str, TimeRange] = field(default_factory=dict)
    times: NDArray[np.float64] | None = None
    trace: Trace | None = None
    first: int = 0

    @property
    def batch(self) -> int:
        """Number of traces."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def gaps(self) -> dict[str, Gap]:
        """Unknown samples (NaN) of signals by name, each within the time in which the signal was seen.

        Signals without any are left out; all are if arrays are not NumPy.
        """
        if self.ops is not NUMPY:
            return {}
        found: dict[str, Gap] = {}
        for name, values in self.env.items():
            unknown = np.isnan(values)
            span = self.spans.get(name)
            if span is not None and self.dt and unknown.any():
                times = self.t0 + self.dt * np.arange(self.samples)
                unknown[(times < span.first) | (times > span.last)] = False
            gap = Gap().with_more(unknown)
            if gap.samples:
                found[name] = gap
        return found

    def like_given(self, values: Array) -> Array:
        """Reshape values (time, batch) to (…, time), the shape in which the signals were given.

        Values that are those of a signal, as of `x >= 0`, are copied.
        """
        if self.ops is NUMPY and values.base is not None:
            values = values.copy()
        return values.swapaxes(0, 1).reshape((*self.shape, len(values)))

    def at_one(self, values: Array) -> Array:
        """Reshape values (1, batch) of one sample to (…), the shape of the signals without the time axis."""
        flat = values.reshape(self.shape)
        return flat if self.shape or self.ops is not NUMPY else np.float64(flat)


class Excerpt(NamedTuple):
    """Samples from `first` to `stop` (exclusive) of a trace that has the sample `at`, or else all."""

    first: int
    at: int
    stop: int

    def within(self, samples: int) -> slice:
        """The samples that are kept of a trace."""
        return slice(self.first, min(self.stop, samples)) if self.at < samples else slice(0, samples)


_FLOAT64 = np.dtype(np.float64)
WHOLE = Excerpt(0, 0, 1 << 60)


def plain_columns(given: Given, needs: Sequence[Need], excerpt: Excerpt) -> dict[str, Array] | None:
    """Return the columns of `arrange` if they need no conversion, else None.

    They need none if they are vectors (time,) in float64 without NaN, and no times are given with them.
    """
    env, samples, kept = {}, 0, slice(0)
    for need in needs:
        name = need.column.name
        x = given.get(name)
        if type(x) is not np.ndarray or x.ndim != 1 or x.dtype != _FLOAT64:
            return None
        if len(x) != samples:
            if samples:
                return None
            samples = len(x)
            if excerpt.at >= samples:
                return None
            kept = excerpt.within(samples)
        x = np.ascontiguousarray(x[kept])
        squares = x.dot(x)
        if squares != squares:  # NaN, as one of them is
            return None
        env[name] = x[:, None]
    return env if samples and given.keys().isdisjoint(CLOCKS) else None


def arrange(
    given: Given | Trace, needs: Sequence[Need], *, plain: bool = False, excerpt: Excerpt = WHOLE
) -> Signals:
    """Convert the signals that requirements need to arrays (time, batch), or an excerpt of them.

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
    if lacking := [need for need in needs if found[need.column.name] is None]:
        there = data if trace is None else {**dict.fromkeys(trace.others), **data, **trace.extras}
        raise TraceError(*(_missing(need, there, name) for need in lacking))
    if not found:  # the numbers of traces and samples are those of any signal, preferably not of a vector
        any_one = min(data, key=lambda key: (key == CLOCK, np.ndim(data[key])), default=None)
        found = {} if any_one is None else {any_one: _find(data, any_one)}
    torch = sys.modules.get("torch")  # not imported to find out
    tensors = [] if torch is None else [key for key, x in found.items() if isinstance(x, torch.Tensor)]
    if tensors and plain:
        found |= {key: found[key].detach().cpu().numpy() for key in tensors}
        tensors = []
    shape, samples = _common_shape(found, name)
    kept = (excerpt if trace is None else WHOLE).within(samples)
    found = {key: x[..., kept] if x.ndim else x for key, x in found.items()}
    samples = kept.stop - kept.start
    if tensors:
        from stlc.compile.backends.torch.ops import TORCH

        given_tensors = [found[key] for key in tensors]
        columns = _torch_columns(found, given_tensors, (*shape, samples))
        return Signals(columns, shape, samples, TORCH, name, first=kept.start)
    columns = {}
    for key, x in found.items():
        array = np.asarray(x, dtype=np.float64)
        if array.shape != (*shape, samples):
            array = np.broadcast_to(array, (*shape, samples))
        columns[key] = np.ascontiguousarray(array.reshape(-1, samples).T)
    if trace is None:
        return Signals(columns, shape, samples, NUMPY, name, first=kept.start)
    changes = _conversions(needs, trace)
    columns = {key: changes[key](values) if key in changes else values for key, values in columns.items()}
    cells = None if trace.moments is None else _cells(trace.moments, columns, changes)
    spans = {key: span for key, span in trace.spans.items() if key in columns}
    known = (name, trace.dt, trace.t0, cells, spans)
    return Signals(columns, (trace.traces,), samples, NUMPY, *known, trace=trace)


def _find(data: Given, name: str) -> Any:
    """Return the array called `name`, also a component such as `q[0]` of a vector `q`; None without one."""
    index = None
    if name not in data:
        match = _COMPONENT.fullmatch(name)
        if match is None or match["name"] not in data:
            return None
        name, index = match["name"], int(match["index"])
    values = data[name] if hasattr(data[name], "shape") else numbers_in(name, data[name])
    if index is None:
        return values
    return values[..., index] if values.ndim >= 2 and index < values.shape[-1] else None


def _missing(need: Need, data: Given, name: str) -> Diagnostic:
    wanted = need.column.name
    near = closest(wanted, data)
    first = islice(data.items(), 40)
    shapes = ", ".join(key if x is None else f"{key} {tuple(np.shape(x))}" for key, x in first)
    mapped = shell(("--map", f"{wanted}={near}"))
    help_ = () if near is None else (f"did you mean `{near}`? map it with  {mapped}",)
    if need.parameter:
        option = f"--set {wanted.partition('[')[0]}={need.column.low or 0:g}{need.column.unit}"
        help_ = (*help_, f"{'or ' if help_ else ''}give it one value for all traces:  {option}")
    message = f"no signal `{wanted}` is given"
    if name != UNNAMED:
        message = f"trace `{name}` has no signal `{wanted}`"
    label, note = f"needed by: {', '.join(need.by)}", (f"arrays in {name}: {shapes}",)
    return Diagnostic("E601", message, need.span, label=label, help=help_, note=note)


def _common_shape(arrays: Mapping[str, Any], name: str) -> tuple[tuple[int, ...], int]:
    """Shape of the arrays without their time axis, and number of samples; single numbers fit any."""

    def unfit(what: str) -> TraceError:
        return TraceError.of("E605", f"{name}: {what}")

    lengths = {key: int(values.shape[-1]) for key, values in arrays.items() if values.ndim}
    if not lengths:
        raise unfit("no signal has a time axis")
    first, samples = next(iter(lengths.items()))
    for key, length in lengths.items():
        if length != samples:
            raise unfit(f"`{key}` has {length} samples, `{first}` has {samples}")
    if not samples:
        raise unfit("the signals hold no samples")
    leading = {tuple(values.shape[:-1]) for values in arrays.values() if values.ndim}
    try:
        shape = leading.pop() if len(leading) == 1 else np.broadcast_shapes(*leading)
    except ValueError:
        shapes = ", ".join(f"{key} {tuple(values.shape)}" for key, values in arrays.items())
        raise unfit(f"the arrays do not fit together: {shapes}") from None
    if 0 in shape:
        raise unfit("the arrays hold no traces")
    return shape, samples


def _torch_columns(
    arrays: Mapping[str, Any], tensors: Sequence[Any], shape: tuple[int, ...]
) -> dict[str, Array]:
    torch = sys.modules["torch"]
    floating = [tensor.dtype for tensor in tensors if tensor.is_floating_point()]
    dtype = reduce(torch.promote_types, floating) if floating else torch.get_default_dtype()
    device = tensors[0].device
    full = (torch.as_tensor(x, dtype=dtype, device=device).broadcast_to(shape) for x in arrays.values())
    return {name: x.reshape(-1, shape[-1]).T for name, x in zip(arrays, full, strict=True)}


def _conversions(needs: Sequence[Need], trace: Trace) -> dict[str, Conversion]:
    """Conversions to declared units, where they differ. Raises TraceError (E605) for other quantities."""
    changes: dict[str, Conversion | None] = {}
    findings: list[Diagnostic] = []
    for column, span in ((need.column, need.span) for need in needs if need.column.name in trace.signature):
        try:
            unit = trace.signature[column.name].unit
            changes[column.name] = conversion(trace.name, column, unit, span)
        except TraceError as error:
            findings += error.diagnostics
    if findings:
        raise TraceError(*findings)
    return {name: change for name, change in changes.items() if change is not None}


def _cells(moments: Moments, columns: Mapping[str, Array], changes: Mapping[str, Conversion]) -> Cells:
    """Recorded values of the signals in `columns` in the units of the specification."""

    def converted(name: str, values: Array) -> Array:
        return changes[name](values).T if name in changes else values.T

    before = {name: converted(name, x) for name, x in moments.before.items() if name in columns}
    after = {
        name: x if moments.after[name] is moments.before[name] else converted(name, moments.after[name])
        for name, x in before.items()
    }
    if CLOCK in columns and CLOCK not in before:
        batch = next((values.shape[1] for values in before.values()), 1)
        before[CLOCK] = after[CLOCK] = np.repeat(moments.times[:, None], batch, axis=1)
    return Cells(moments.times, moments.starts, before, after, {CLOCK: -1, **moments.clocks})


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
        """Return a gap that includes `unknown`, (samples,) or (samples, traces), from sample `offset` on."""
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
