"""Logs of PX4 as `.ulg` files (ULog; extra `ulg`).

The field `z` of the topic `vehicle_local_position` is called `vehicle_local_position.z`, an element of an
array `vehicle_attitude.q[0]`. Topics with an instance (`multi_id`) other than 0 have it behind their name, as
`battery_status_1.voltage_v`; `battery_status[1].voltage_v` means the same. The time of a message is its field
`timestamp`.
"""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Mapping
from contextlib import redirect_stdout
from itertools import islice
from pathlib import Path
from typing import Any

from stlc.extras import needed
from stlc.trace.formats.arrays import MAX_OTHERS, Array, Arrays
from stlc.trace.formats.registry import MAX_BYTES, damage, opened, unreadable
from stlc.trace.recording import ALL, ClockGroup, Recording, Wanted

_MAX_FIELDS = 2_000_000
"""Most fields of all subscriptions of a log; in real ones there are some ten thousand."""
_CLOCK = "timestamp"


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read the topics of the wanted names; each is a group with times of its own.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        MissingError: R301, `pyulog` is not installed.
        TraceError: E603, the file is of another format, damaged at its beginning, or larger than the limit.
    """
    with opened(path):
        file = _Watched(path)
    with file, damage(path), redirect_stdout(io.StringIO()):
        if path.stat().st_size > MAX_BYTES:
            raise unreadable(path, f"it is larger than {MAX_BYTES / 1e9:.0f} GB", advice="split it")
        heads = {name.partition(".")[0] for name in (*(wanted.names or ()), wanted.clock)}
        topics = heads | {re.sub(r"_\d+$|\[\d+\]$", "", head) for head in heads}  # topic_1 is a topic
        log = _bounded()(file, None if wanted.names is None else topics)
    found = Arrays(wanted)
    prefixes = Counter(_instance(data) for data in log.data_list)
    groups = []
    for data in log.data_list:
        exact = f"{data.name}[{data.multi_id}]"
        arrays: dict[str, Array] = {}
        for field, values in data.data.items():
            name, unique = f"{_instance(data)}.{field}", f"{exact}.{field}"
            if field == _CLOCK or field.rpartition(".")[2].startswith("_padding"):
                continue
            several = prefixes[_instance(data)] > 1
            if wanted.reads(unique) and (several or wanted.names):
                arrays[unique] = values
            if several:
                found.clashes.setdefault(name, {})[f"{data.name} {data.multi_id}"] = unique
            elif wanted.reads(name):
                arrays[name] = values
        if _CLOCK not in data.data:
            found.refuse(_instance(data), f"has no field `{_CLOCK}`: its times are unknown")
        elif arrays:
            groups.append(ClockGroup(arrays, data.data[_CLOCK] * 1e-6, f"{_instance(data)}.{_CLOCK}"))
    known = (f"{each.name}.{name}" for each in log.message_formats.values() for _, _, name in each.fields)
    found.others += islice(known, MAX_OTHERS)
    if file.cut:
        found.remarks.append(f"`{path}` ends within a message: it was cut short")
    if log.file_corruption:
        found.remarks.append(f"`{path}` is damaged: messages that cannot be decoded are left out")
    if lost := sum(each.duration for each in log.dropouts):
        found.remarks.append(f"`{path}` has gaps: the logger lost messages for {lost / 1000:.3g} s in all")
    return found.recording(path, groups)


def _instance(data: Any) -> str:
    return f"{data.name}_{data.multi_id}" if data.multi_id else str(data.name)


class _Watched(io.BufferedReader):
    """A file that notices when it ends within what was to be read."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.cut = False

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self.cut = self.cut or (size is not None and len(data) < size and (len(data) > 0 or size != 3))
        return data


class _Formats(dict[str, Any]):
    """Definitions of messages, which limits how many fields they may have when they are inside each other."""

    left = _MAX_FIELDS

    def __getitem__(self, name: str) -> Any:
        found = super().__getitem__(name)
        self.left -= sum(max(count, 1) for _, count, _ in found.fields) + 1
        if self.left < 0:
            raise RuntimeError("its messages have too many fields")
        return found


def _bounded() -> Any:
    """Return pyulog's class of logs, with a limit for the fields of nested definitions."""
    base = needed("pyulog").ULog

    class Bounded(base):  # type: ignore[misc, valid-type]
        def _read_file_definitions(self) -> None:
            super()._read_file_definitions()
            self._message_formats: Mapping[str, Any] = _Formats(self._message_formats)

    return Bounded
