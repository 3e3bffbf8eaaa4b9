"""Several objects in one table: the rows of each become a trace of its own.

A column tells the objects apart if the user names it, or if time falls back (or stands still) without it and
rises within each of its groups.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import TraceError
from stlc.trace.clocks import Candidate, ClockSetting, candidates
from stlc.trace.formats.registry import MAX_LETTERS
from stlc.trace.formats.table import GROUPS
from stlc.trace.recording import ClockGroup, Recording, absent, is_group_name

Array = NDArray[Any]

NONE = "none"
"""Name that says that a table has one object."""
MAX_TRACKS = 10_000


@dataclass(slots=True)
class OneTrace:
    """Check of a table that is read in pieces: all of its lines belong to one trace.

    Attributes:
        name: name of the table, for messages.
    """

    name: str
    _key: object = None

    def require(self, group: str, key: object) -> None:
        """Check a line whose cell in the column `group` is `key`, a number or a word.

        Raises TraceError (E605) if an earlier line belongs to another trace.
        """
        if self._key is None:
            self._key = key
        elif str(key) != str(self._key):  # as texts: an empty cell, NaN, equals itself
            raise self.error(f"the traces {_label(self._key)} and {_label(key)} ({group})")

    def error(self, traces: str) -> TraceError:
        """Return the error E605: the table holds several traces; `traces` says which or how many."""
        message = f"`{self.name}` holds {traces}; in pieces only one can be read"
        return TraceError.of("E605", message, help=("put each trace into a file of its own",))


def separated(
    recording: Recording, group: str, setting: ClockSetting, read: Mapping[str, bool] | None
) -> tuple[Recording, ...]:
    """Return one recording for each object in a table; objects with equal times are the traces of one.

    Args:
        recording: content of a file.
        group: name of the column that tells objects apart, or several with commas; one object is `agent=2`;
            "" if the file decides.
        setting: the clock that the user asks for.
        read: name of a signal that is read -> whether it may be the time itself; None: all are read.

    Raises:
        TraceError: E601, there is no such column, or several may tell objects apart; E602, time falls back,
            and no column tells objects apart; E605, there are too many objects.
    """
    flat = len(recording.groups) == 1 and recording.groups[0].clock is None
    arrays = recording.groups[0].arrays if flat else {}
    if [len(shape) for shape in {values.shape for values in arrays.values()}] != [1]:
        if group and group != NONE:
            raise TraceError(absent(recording.name, group, recording.signals))
        return (recording,)
    found = candidates(recording, recording.groups[0], setting, read)
    rising = [each for each in found.values() if each.rises]
    best = max(rising or found.values(), key=lambda each: each.rank, default=None)
    clock = None if best is None else best.seconds
    one = dict(part.partition("=")[::2] for part in group.split(",") if "=" in part)
    named = [part.partition("=")[0] for part in group.split(",")] if group else []
    named = named or _telling(recording, clock, bool(rising), read)
    if not named or named == [NONE]:
        if best is not None and not rising:
            _require_no_runs(recording, best)
        return (recording if named else replace(recording, labels=_labels(arrays, read)),)
    if missing := [name for name in named if name not in arrays]:
        raise TraceError(absent(recording.name, missing[0], (*recording.signals, *recording.others)))
    parts = tuple(_split(recording, named, one, read))
    if not parts:
        known = ", ".join(sorted({_label(key) for key in arrays[named[0]][:1000].tolist()})[:8])
        message = f"`{recording.name}` holds no object `{group}`"
        raise TraceError.of("E601", message, note=(f"{named[0]}: {known}, …",))
    return parts


def _telling(
    recording: Recording, clock: Array | None, rises: bool, read: Mapping[str, bool] | None
) -> list[str]:
    arrays = recording.groups[0].arrays
    usual = [name for name in GROUPS if name in arrays]
    if clock is None:
        return usual[:1]
    with np.errstate(all="ignore"):
        repeated = len(clock) > 1 and not bool((np.diff(clock) > 0).all())
    if not repeated:
        return [name for name in usual[:1] if len(np.unique(arrays[name])) <= max(len(clock) // 2, 1)]
    names = [
        name for name in arrays if is_group_name(name) and (read is None or name not in read or name in usual)
    ]
    fitting: dict[str, Array] = {}
    for name in names:
        labels = np.unique(arrays[name], return_inverse=True)[1]
        count = int(labels.max(initial=-1)) + 1
        order = np.argsort(labels, kind="stable")
        steps, same = np.diff(clock[order]), np.diff(labels[order]) == 0
        if count <= max(len(clock) // 2, 1) and bool((steps[same] > 0).all()):
            fitting[name] = labels
    if not fitting and usual and not rises:
        return usual[:1]
    different = [name for name in fitting if not np.array_equal(fitting[name], next(iter(fitting.values())))]
    if different:
        names = [next(iter(fitting)), *different]
        message = (
            f"which of {', '.join(f'`{n}`' for n in names)} tells the objects in `{recording.name}` apart?"
        )
        raise TraceError.of("E601", message, help=(f"--group {names[0]}",))
    return list(fitting)[:1]


def _labels(arrays: Mapping[str, Array], read: Mapping[str, bool] | None) -> dict[str, int]:
    """Columns that are called like the name of an object and have few values, with their number."""
    found = {}
    for name, values in arrays.items():
        if is_group_name(name) and name not in (read or ()) and values.dtype.kind in "biufU":
            count = len(np.unique(values))
            if 2 <= count <= len(values) // 2:
                found[name] = count
    return found


def _require_no_runs(recording: Recording, best: Candidate) -> None:
    """Raise TraceError (E602) if time falls back: runs below each other are not one trace."""
    clock = best.seconds
    back = np.flatnonzero(np.diff(clock) < 0)
    if len(back) and np.isfinite(clock).all():
        i = int(back[0])
        line = "" if recording.line is None else f"line {recording.line(i + 1)}: "
        message = (
            f"time in `{recording.name}` runs backwards: {line}t[{i}] = {clock[i]:.6g} s, "
            f"t[{i + 1}] = {clock[i + 1]:.6g} s" + (f"; {len(back)} such places" if len(back) > 1 else "")
        )
        help_ = (
            "--group NAME  judges the runs or objects that a column tells apart, a trace each",
            f"--clock NAME  names the clock, if it is not `{best.name}`",
        )
        raise TraceError.of("E602", message, help=help_)


def _split(
    recording: Recording, named: list[str], one: Mapping[str, str], read: Mapping[str, bool] | None
) -> Iterator[Recording]:
    group = recording.groups[0]
    rest = {name: x for name, x in group.arrays.items() if name not in named or name in (read or ())}
    keys = [group.arrays[name] for name in named]
    for name, values in zip(named, keys, strict=True):
        if values.dtype.kind == "U" and (np.char.str_len(values) >= MAX_LETTERS).any():
            message = f"objects in `{recording.name}` have names of {MAX_LETTERS} letters or more in `{name}`"
            raise TraceError.of("E605", message, help=("number them",))
    coded = [np.unique(values, return_inverse=True) for values in keys]
    codes = np.ravel_multi_index([inverse for _, inverse in coded], tuple(len(labels) for labels, _ in coded))
    different, first, sizes = np.unique(codes, return_index=True, return_counts=True)
    if len(different) > MAX_TRACKS:
        message = f"`{','.join(named)}` tells {len(different):,} objects in `{recording.name}` apart"
        raise TraceError.of("E605", message, help=("--group none  if the table is one trace",))
    order = np.argsort(codes, kind="stable")
    if not one and len(set(sizes.tolist())) == 1:
        rows = order.reshape(len(different), -1)
        head = replace(recording, groups=(ClockGroup({name: x[rows[0]] for name, x in rest.items()}, None),))
        clocks = candidates(head, head.groups[0], ClockSetting(), None)
        times = {part for name in clocks for part in name.split("+")}
        if all((rest[name][rows] == rest[name][rows[0]]).all() for name in times):
            arrays = {name: x[rows[0]] if name in times else x[rows] for name, x in rest.items()}
            yield replace(recording, groups=(ClockGroup(arrays, None, group.named),))
            return
    for begin, size, i in zip(np.cumsum(sizes) - sizes, sizes, first, strict=True):
        labels = {name: _label(values[i]) for name, values in zip(named, keys, strict=True)}
        if all(one.get(name, label) == label for name, label in labels.items()):
            track = ",".join(f"{name}={label}" for name, label in labels.items())
            arrays = {name: x[order[begin : begin + size]] for name, x in rest.items()}
            groups, name = (ClockGroup(arrays, None, group.named),), f"{recording.name} ({track})"
            yield replace(recording, name=name, track=track, groups=groups, line=None)


def _label(key: Any) -> str:
    return str(key) if isinstance(key, str) else f"{key:g}"
