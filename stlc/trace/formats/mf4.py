"""Measurements as `.mf4` and `.mdf` files (ASAM MDF of versions 3 and 4; extra `mf4`).

Each group of channels has times of its own, from its master channel. A channel whose name occurs in several
groups is called `group[1].speed`, as its second group; the channel at place 2 of it is `group[1].channel[2]`.
Nothing in a file is executed: a channel that is defined by a formula is not read, nor are attachments.
"""

from __future__ import annotations

import io
import logging
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from traceback import walk_tb
from typing import Any

import numpy as np

from stlc.extras import needed
from stlc.trace.formats.arrays import Array, Arrays
from stlc.trace.formats.registry import MAX_BYTES, damage, opened, room_for, unreadable
from stlc.trace.recording import ALL, ClockGroup, Recording, Wanted

_TIMES, _DEFLATE = (0, 1), (1, 2)
"""Types of synchronisation that are times (version 4), and of packed blocks."""
_FORMULA3, _FORMULA4 = 10, 3
_BLOCK = 1 << 20


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read the wanted channels. Raises UsageError (U102), MissingError (R301) or TraceError (E603)."""
    with opened(path):
        file = _Counted(path)
    with file, damage(path):
        if path.stat().st_size > MAX_BYTES:
            raise unreadable(path, f"it is larger than {MAX_BYTES / 1e9:.0f} GB", advice="split it")
        with _open(file) as measurement:
            made = _Measurement(path, file, measurement, wanted)
            groups = [made.group(g, group) for g, group in enumerate(measurement.groups)]
        return made.found.recording(path, (group for group in groups if group.arrays))


class _Counted(io.BufferedReader):
    """A file that can be read a limited number of times: blocks that follow each other in a circle end."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.left = self.most = 10_000 + path.stat().st_size // 4

    def read(self, size: int | None = -1, /) -> bytes:
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("its blocks follow each other without end")
        return super().read(size)


@contextmanager
def _open(file: _Counted) -> Iterator[Any]:
    """Context with the measurement in a file, in which the library prints nothing."""
    logger = logging.getLogger("asammdf")
    logger.disabled, before = True, logger.disabled
    try:
        with redirect_stdout(io.StringIO()), needed("asammdf").MDF(file) as measurement:
            yield measurement
    except Exception as error:
        for frame, _ in walk_tb(error.__traceback__):
            if temporary := getattr(frame.f_locals.get("self"), "_tempfile", None):
                frame.f_locals["self"]._closed = True  # it prints a traceback if it closes itself
                temporary.close()
        raise
    finally:
        logger.disabled = before


class _Measurement:
    """An open file, and what is kept of it."""

    def __init__(self, path: Path, raw: _Counted, file: Any, wanted: Wanted) -> None:
        self.path, self.raw, self.file, self.wanted, self.found = path, raw, file, wanted, Arrays(wanted)
        self.old, self.room = str(file.version) < "4", room_for(path)

    def group(self, g: int, group: Any) -> ClockGroup:
        """Read the channels of group number `g` that are wanted."""
        master = self.file.masters_db.get(g)
        why = ""
        if master is None:
            why = "has no times: its group has no master channel"
        elif not self.old and group.channels[master].sync_type not in _TIMES:
            why = f"is recorded over `{group.channels[master].name}`, which is not a time"
        elif self._has_formula(group.channels[master]):
            why = "has no times: a formula defines them"
        kept, names = replace(self.found, kept={}), dict[str, int]()
        for c in range(len(group.channels)):
            for name in self._names(g, c, group) if c != master else ():
                if why or self._has_formula(group.channels[c]):
                    kept.refuse(name, why or "is defined by a formula, which is not evaluated")
                else:
                    names[name] = c
        if not names:
            return ClockGroup({}, None)
        self._require_room(group, names.values())
        for name, c in names.items():
            self.raw.left = self.raw.most
            signal = self.file.get(group=g, index=c, ignore_invalidation_bits=True)
            kept.add(name, _values(signal))
            kept.units[name] = str(signal.unit or "")
        clock = np.asarray(self.file.get_master(g), dtype=np.float64)
        if len(clock) < (every := group.channel_group.cycles_nr):
            kept.remarks.append(f"`{self.path}` is cut short: group {g} has {len(clock)} of {every} records")
        return ClockGroup(kept.kept, clock, str(group.channels[master].name))

    def _names(self, g: int, c: int, group: Any) -> list[str]:
        """Return the names under which a channel is read; clashes are noted."""
        name, masters = str(group.channels[c].name), self.file.masters_db
        same = [place for place in self.file.channels_db.get(name, ()) if masters.get(place[0]) != place[1]]
        alone = sum(place[0] == g for place in same) < 2
        exact = f"group[{g}].{name}" if alone else f"group[{g}].channel[{c}]"
        found = [exact] if self.wanted.reads(exact) and (len(same) > 1 or self.wanted.names) else []
        if len(same) > 1 and self.wanted.reads(name):
            source = str(getattr(group.channel_group, "acq_name", "") or "")
            shown = f"group {g} {source}".strip() + ("" if alone else f", {c}")
            self.found.clashes.setdefault(name, {})[shown] = exact
        elif self.wanted.reads(name):
            found.append(name)
        elif not found:
            self.found.note(name)
        return found

    def _has_formula(self, channel: Any) -> bool:
        """True if a formula is in the conversion of a channel, or in one that it refers to."""
        todo = [channel.conversion]
        for each in todo:
            kind = getattr(each, "conversion_type", None)
            if kind == (_FORMULA3 if self.old else _FORMULA4) or len(todo) > 10_000:
                return True
            todo += (getattr(each, "referenced_blocks", None) or {}).values()
        return False

    def _require_room(self, group: Any, channels: Iterable[int]) -> None:
        """Check that the data of a group unpack to no more than they declare, and than there is room for."""
        blocks = list(group.get_data_blocks())
        for c in () if self.old else channels:
            blocks += group.get_signal_data_blocks(c)
        self.room -= sum(block.original_size for block in blocks)
        if self.room < 0:
            raise unreadable(self.path, "it unpacks to more than there is room for", advice="split it")
        for block in filter(lambda block: block.block_type, blocks):
            self.raw.seek(block.address)
            engine, rest, size = zlib.decompressobj(), self.raw.read(block.compressed_size), 0
            while block.block_type in _DEFLATE and rest and size <= block.original_size:
                size += len(engine.decompress(rest, _BLOCK))
                rest = engine.unconsumed_tail
            if block.block_type not in _DEFLATE or size > block.original_size:
                raise unreadable(self.path, "a packed block is no deflate, or holds more than it declares")


def _values(signal: Any) -> Array:
    """Return the values of a channel; those that are marked as invalid are NaN, or empty texts."""
    values = np.asarray(signal.samples)
    if values.dtype.names is not None and values.dtype[0].subdtype is not None:  # an array and its axes
        values = values[values.dtype.names[0]]
    bad = np.asarray(signal.invalidation_bits if signal.invalidation_bits is not None else False, dtype=bool)
    if not bad.any() or values.dtype.kind not in "biufSU":
        return values
    return np.where(bad, values.dtype.type() if values.dtype.kind in "SU" else np.nan, values)
