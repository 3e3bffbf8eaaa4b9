"""The content of a trace file before resampling: arrays by name, and their times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.registry import closest
from stlc.signature import Column
from stlc.source import Span
from stlc.trace.meta import TraceMeta
from stlc.units import CELSIUS, DIMENSIONLESS, SYMBOLS, Unit, means_celsius, parse_unit, same_dims

Array = NDArray[Any]
Floats = NDArray[np.float64]

CLOCK = "t"
ROSTOPIC = "%time"
"""Name of the clock in output of `rostopic echo -p`, in nanoseconds."""
CLOCKS = (CLOCK, "time", "times", "timestamp", "__time", "tout", ROSTOPIC)
"""Names of a clock, case-insensitive."""
EXTRA = "extra."
MAX_COMPONENTS = 1000
"""Most components of a vector."""


@dataclass(frozen=True, slots=True)
class ClockGroup:
    """Group of signals that share their sampling times.

    Attributes:
        arrays: signal -> (samples,), (traces, samples) or (…, samples, components).
        clock: times in seconds, (samples,); None if the file contains none.
        named: name of the time column in the file.
    """

    arrays: Mapping[str, Array]
    clock: Array | None
    named: str = CLOCK


@dataclass(frozen=True, slots=True)
class Recording:
    """Content of a trace file.

    Attributes:
        name: the path as the user gave it, for messages.
        groups: groups of signals with common times; one group if the file has one time column.
        columns: signal -> unit, kind and range, if the file gives them.
        meta: origin of the trace.
        extras: all other arrays in the file.
    """

    name: str
    groups: tuple[ClockGroup, ...]
    columns: Mapping[str, Column] = field(default_factory=dict)
    meta: TraceMeta = field(default_factory=TraceMeta)
    extras: Mapping[str, Array] = field(default_factory=dict)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of all signals."""
        return tuple(name for group in self.groups for name in group.arrays)

    def clocked_by(self, signal: str) -> Recording:
        """Return a copy in which `signal` is the time of its group of signals.

        Raises:
            TraceError: E601, there is no such signal.
        """
        for index, group in enumerate(self.groups):
            if group.clock is not None and group.named == signal:
                return self
            if signal in group.arrays:
                rest = {name: values for name, values in group.arrays.items() if name != signal}
                if group.clock is not None:
                    rest[group.named] = group.clock
                changed = ClockGroup(rest, group.arrays[signal].reshape(-1), signal)
                groups = (*self.groups[:index], changed, *self.groups[index + 1 :])
                return replace(self, groups=groups)
        raise TraceError(absent(self.name, signal, self.signals))


def absent(trace: str, signal: str, known: Iterable[str]) -> Diagnostic:
    """Finding E601: the trace has no such signal."""
    names = list(known)
    near = closest(signal, names)
    return Diagnostic(
        "E601",
        f"trace `{trace}` has no signal `{signal}`",
        help=(f"did you mean `{near}`?",) if near else (),
        note=(f"signals in {trace}: {', '.join(names)}",),
    )


def clock_among(names: Iterable[str]) -> str | None:
    """Return the name of the time column: `t`, else a usual name for time such as `time`.

    A usual name is returned only if exactly one of them occurs; otherwise None.
    """
    known = list(names)
    found = [name for name in known if name.strip().lower() in CLOCKS]
    return CLOCK if CLOCK in known else found[0] if len(found) == 1 else None


def of_arrays(path: Path, arrays: Mapping[str, Array], meta: TraceMeta | None = None) -> Recording:
    """Return a recording of arrays that share one time column, if there is one.

    Arrays called `extra.…` are not signals: they become the extras of the recording.
    """
    named = clock_among(arrays)
    extras = {n.removeprefix(EXTRA): values for n, values in arrays.items() if n.startswith(EXTRA)}
    signals = {n: values for n, values in arrays.items() if n != named and not n.startswith(EXTRA)}
    group = ClockGroup(signals, None) if named is None else ClockGroup(signals, arrays[named], named)
    return Recording(str(path), (group,), meta=meta or TraceMeta(), extras=extras)


def unit_of(path: Path, name: str, text: str) -> Unit:
    """Parse the unit that a file gives for a column. Raises TraceError (E605) for an invalid unit."""
    try:
        return parse_unit(text) if text else DIMENSIONLESS
    except ValueError as error:
        help_ = (CELSIUS,) if means_celsius(text) else ()
        raise TraceError(Diagnostic("E605", f"column `{name}` of `{path}`: {error}", help=help_)) from None


def fit(name: str, arrays: Mapping[str, Array], samples: int) -> dict[str, Array]:
    """Return signals as (traces, samples); a vector is split into its components `q[0]`, `q[1]`, ….

    Raises:
        TraceError: E601, there are no signals; E605, shapes of arrays do not fit together.
    """
    findings: list[Diagnostic] = []
    data: dict[str, Array] = {}
    for signal, values in arrays.items():
        if values.ndim in (1, 2) and values.shape[-1] == samples:
            data[signal] = np.atleast_2d(values)
        elif values.ndim in (2, 3) and values.shape[-2] == samples and values.shape[-1] <= MAX_COMPONENTS:
            stacked = values[None] if values.ndim == 2 else values
            data |= {f"{signal}[{i}]": stacked[..., i] for i in range(values.shape[-1])}
        else:
            shape = " x ".join(map(str, values.shape)) or "a single number"
            message = f"`{signal}` in `{name}` is {shape}, and `t` has {samples} samples"
            most = f"(samples, components up to {MAX_COMPONENTS})"
            help_ = (f"signals are (samples,), (traces, samples) or {most}",)
            findings.append(Diagnostic("E605", message, help=help_))
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
    return {signal: np.broadcast_to(values, (traces, samples)) for signal, values in data.items()}


@dataclass(frozen=True, slots=True)
class Conversion:
    """Conversion from one unit to another: `x * factor + shift`."""

    factor: float
    shift: float

    def __call__(self, values: Any) -> Any:
        """Convert `values` to the new unit."""
        scaled = values if self.factor == 1.0 else values * self.factor
        return scaled + self.shift if self.shift else scaled


def conversion(trace: str, column: Column, recorded: Unit, span: Span | None = None) -> Conversion | None:
    """Return the conversion from the unit in the trace, `recorded`, to the declared unit of `column`.

    None is returned if the units are equal, or if one is unknown.

    Raises:
        TraceError: E605, the units measure different quantities.
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
