"""The content of a trace file before resampling: arrays by name, and their times."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.signature import Column
from stlc.source import Span
from stlc.trace.meta import TraceMeta
from stlc.units import Unit

Array = NDArray[Any]

CLOCK = "t"
ROSTOPIC = "%time"
"""Name of the clock in output of `rostopic echo -p`, in nanoseconds."""
EXTRA = "extra."
_CLOCKED = re.compile(
    r"(?:t|times?|timestamp|time_?stamp|tout|stamp|date|datetime|date_?time|clock|elapsed|epoch|secs?|nanosec|"
    r"nsecs?|nanos|frame|cycle|step|tick)"
    r"(?:[ _]?(?:s|secs?|seconds?|ms|msecs?|millis|us|usecs?|micros|ns|nsecs?|nanos|min|utc|boot|id|number))"
    r"{0,2}",
    re.IGNORECASE,
)
_COUNTS = re.compile(
    r"(?:.*[._\s/])?(?:frame|cycle|step|tick)(?:[ _]?(?:id|number|nr|no|count|index))?", re.IGNORECASE
)
_OF = (
    r"(?:gps|gnss|utc|sim|ros|sys|system|log|host|wall|unix|boot|server|local|device|rx|tx|recv|received?|sent|send|"
    r"arrival|arrived|publish|published|recorded?|captured?)"
)
_STAMP = r"(?:t|time|timestamp|stamp|clock)"
_OF_SOURCE = re.compile(rf"(?i:{_OF}[ _]{_STAMP}|{_STAMP}[ _]{_OF})")
_GROUPED = re.compile(
    r"(?i:(?:.*[._\s/])?(?:trace|agent|id|track|vehicle|unit|run|episode|engine|case|object|trial|subject|series))"
    r"|.*(?:_id|_ID|[a-z]I[dD])"
)


def clock_rank(name: str) -> int:
    """Return 2 if a column is called like a clock, 1 if its last words are, as in `motor_time`; else 0."""
    if len(name) > _LONGEST:
        return 0
    leaf = re.split(r"[./]", name)[-1].strip("# _%")
    if name.strip() == ROSTOPIC or _CLOCKED.fullmatch(leaf):
        return 2
    starts = (found.end() for found in re.finditer(r"[_\s](?!t\b)", leaf))
    return int(any(_CLOCKED.fullmatch(leaf, start) for start in starts) or is_source_time(name))


def is_source_time(name: str) -> bool:
    """True if a column is called like the time of a source, such as `gps_time` or `time_received`."""
    return len(name) <= _LONGEST and _OF_SOURCE.fullmatch(re.split(r"[./]", name)[-1]) is not None


def is_count_name(name: str) -> bool:
    """True if a column of this name counts samples, such as `frame`."""
    return len(name) <= _LONGEST and _COUNTS.fullmatch(name) is not None


def is_group_name(name: str) -> bool:
    """True if a column of this name may tell traces apart."""
    return len(name) <= _LONGEST and _GROUPED.fullmatch(name.strip()) is not None


_LONGEST = 80
"""Letters of the name of a clock or of a group."""
_SHOWN = 40
"""Names that a message lists."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """Request to the reader of a trace file; the reader may leave out everything else.

    Attributes:
        names: names in the file of the signals that are read, such as `v`, `q[0]`, `scan.ranges`,
            `joint_states.position[elbow]` or `/cmd/linear.x`; None: all.
        clock: name of the clock; "" if the file decides.
        groups: names of the columns that tell the traces of a table apart; empty if the file decides.
        columns: names of the columns of a table without a header.
    """

    names: frozenset[str] | None = None
    clock: str = ""
    groups: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()

    def reads(self, name: str) -> bool:
        """True if the array `name`, a component (`q[0]` of `q`) or a part of it (`s.x` of `s`) is read."""
        if self.names is None or name in self.names or name == self.clock:
            return True
        if name.partition("[")[0] in self.names:
            return True
        return any(each.startswith((f"{name}[", f"{name}.")) for each in (*self.names, self.clock))

    def keeps(self, name: str) -> bool:
        """True if the array `name` is read, or may be needed to tell its times or its traces."""
        return self.reads(name) or name in self.groups or clock_rank(name) > 0 or is_group_name(name)


ALL = Wanted()


@dataclass(frozen=True, slots=True)
class Clock:
    """Clock of a group of signals, as it was found.

    Attributes:
        name: name of the array.
        unit: unit of its numbers, or the kind of its words; "" if nothing says it (then it is seconds).
        others: names of further candidates.
        why: reason of the choice: `--clock`, or what states the unit.
    """

    JSON: ClassVar = "name unit why others"

    name: str
    unit: str = ""
    others: tuple[str, ...] = ()
    why: str = ""

    @property
    def plain(self) -> bool:
        """True if nothing was decided: the only candidate, in seconds."""
        return self.unit in ("", "s") and not self.others

    def __str__(self) -> str:
        told = f"`{self.name}`" + (f" ({self.unit})" if self.unit else "")
        return told + "".join(f", not `{each}`" for each in self.others)


@dataclass(frozen=True, slots=True)
class ClockGroup:
    """Group of signals that share their sampling times.

    Attributes:
        arrays: signal -> (samples,), (traces, samples) or (…, samples, components); numbers or texts. If
            `clock` is None, one of them may be the clock.
        clock: times, (samples,), as the reader of the file knows them: seconds, or whole nanoseconds since
            1970 (int64); None if they are among the arrays, or if there are none.
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
        units: signal -> its unit as text, as the file writes it. It is parsed if the signal is read.
        others: names in the file that were left out, for messages; not necessarily all.
        clashes: name -> the sources that have this name (topics, columns) -> the name that is unambiguous. It
            is an error to read such a name.
        refused: name -> why it has no values (a reason that continues "`name` …"). It is an error to read it.
        remarks: warnings about the file, such as a recording that was cut short.
        line: function from the index of a row to its line in the file; None if rows are no lines.
        clocks: the clocks of its groups, once they are chosen.
        track: the object in a table that this is, such as `agent=2`; "" if the file holds one.
        labels: column that seems to tell objects apart, in a table of one object -> number of its values.
    """

    name: str
    groups: tuple[ClockGroup, ...]
    columns: Mapping[str, Column] = field(default_factory=dict)
    meta: TraceMeta = field(default_factory=TraceMeta)
    extras: Mapping[str, Array] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    others: tuple[str, ...] = ()
    clashes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[Diagnostic, ...] = ()
    line: Callable[[int], int] | None = None
    clocks: tuple[Clock, ...] = ()
    track: str = ""
    labels: Mapping[str, int] = field(default_factory=dict)

    def unit(self, name: str) -> str:
        """Return the unit that the file states for an array, as text; "" if there is none."""
        column = self.columns.get(name)
        return self.units.get(name, "") or ("" if column is None else column.unit.text)

    def column(self, name: str) -> Column:
        """Return what the file says of a signal: its unit, kind and range.

        Raises TraceError (E605) for an invalid unit.
        """
        known = self.columns.get(name)
        return known or Column(name, unit_of(Path(self.name), name, self.units.get(name, "")))

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of all signals."""
        return tuple(name for group in self.groups for name in group.arrays)


def absent(trace: str, signal: str, known: Iterable[str]) -> Diagnostic:
    """Finding E601: the trace has no such signal."""
    names = list(known)
    return Diagnostic(
        "E601",
        f"trace `{trace}` has no signal `{signal}`",
        note=(f"signals in {trace}: {', '.join(names[:_SHOWN])}{', …' if len(names) > _SHOWN else ''}",),
    ).near(signal, names)


def unit_of(path: Path | str, name: str, text: str) -> Unit:
    """Parse the unit that a recording gives for a column. Raises TraceError (E605) for an invalid unit."""
    try:
        return Unit.parse(text) if text else Unit.ONE
    except ValueError as error:
        message = f"column `{name}` of `{path}`: {error}"
        raise TraceError.of("E605", message, help=Unit.celsius_advice(text)) from None


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
        elif not values.ndim:
            data[signal] = np.broadcast_to(values, (1, samples))
        elif (
            values.ndim in (2, 3)
            and values.shape[-2] == samples
            and values.shape[-1] <= Column.MAX_COMPONENTS
        ):
            stacked = values[None] if values.ndim == 2 else values
            data |= {f"{signal}[{i}]": stacked[..., i] for i in range(values.shape[-1])}
        else:
            shape = " x ".join(map(str, values.shape)) or "a single number"
            message = f"`{signal}` in `{name}` is {shape}, and `t` has {samples} samples"
            most = f"(samples, components up to {Column.MAX_COMPONENTS})"
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
        raise TraceError.of("E601", f"trace `{name}` has no signals")
    if not traces:
        raise TraceError.of("E605", f"the arrays of `{name}` hold no traces")
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
    if not recorded.same_dims(wanted):
        message = f"`{column.name}` is in [{recorded}] in `{trace}`, the specification declares [{wanted}]"
        coulombs = wanted.dims == Unit.SYMBOLS["K"].dims and recorded.text == "C"
        help_ = (f"[C] is coulombs: name the column `{column.name} [degC]`",) if coulombs else ()
        raise TraceError.of("E605", message, span, help=help_)
    found = Conversion(
        float(recorded.ratio / wanted.ratio), float((recorded.offset - wanted.offset) / wanted.ratio)
    )
    return None if found == Conversion(1.0, 0.0) else found
