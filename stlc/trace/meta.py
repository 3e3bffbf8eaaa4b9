"""Metadata of a trace, as JSON: its origin, and the meaning of its signals."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from stlc.jsontext import loads
from stlc.signature import Column, Kind, Role, Signature
from stlc.trace.formats.registry import unreadable
from stlc.units import Unit

_TYPES: Mapping[str, tuple[type, ...]] = {
    "str": (str,),
    "int | None": (int, NoneType),
    "float | None": (int, float, NoneType),
    "Mapping[str, str]": (dict,),
}
"""Declared type of a field of the metadata -> types of its value in JSON."""


@dataclass(frozen=True, slots=True)
class Carried:
    """A specification that is stored in a trace.

    Attributes:
        name: name of the specification; "" if unknown.
        path: path of its file.
        text: its whole text; "" if the trace does not contain it.
        library: texts of the files that it imports: path relative to the folder of the specification -> text.
        overrides: constants that were overridden, with their values as texts.
    """

    name: str
    path: str
    text: str
    library: Mapping[str, str]
    overrides: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class TraceMeta:
    """Metadata of a trace; every field may be unknown ("" or None).

    Attributes:
        spec_name: name of the specification.
        spec_path: path of the specification as the user gave it.
        spec_text: whole text of the specification, so that `stlc check` needs no other file.
        spec_library: texts of the files that it imports: path relative to the folder of the specification ->
            text.
        spec_set: constants that were overridden, with their values as texts.
        spec_hash: SHA-256 of these texts, hexadecimal.
        judge_path: path of a second specification, which evaluates closed-loop runs. The fields `judge_text`,
            `judge_library` and `judge_set` have the same meaning for it as `spec_text`, `spec_library` and
            `spec_set` for the first one. If `judge_text` is "", there is no second specification, and the
            first one evaluates the trace.
        system_name: name of the system.
        system_path: path of the system file as the user gave it.
        system_text: text of the system file.
        system_hash: SHA-256 of the system.
        run: name of the training run that recorded the trace.
        seed: seed of the random numbers.
        horizon: planning horizon T in steps.
        dt: time step in seconds.
        origin: absolute time of time 0 in ns since 1970, for logs that contain the time of day.
        created: time of recording, ISO 8601.
        stlc_version: version of stlc that recorded the trace.
    """

    spec_name: str = ""
    spec_path: str = ""
    spec_text: str = ""
    spec_library: Mapping[str, str] = field(default_factory=dict)
    spec_set: Mapping[str, str] = field(default_factory=dict)
    spec_hash: str = ""
    judge_path: str = ""
    judge_text: str = ""
    judge_library: Mapping[str, str] = field(default_factory=dict)
    judge_set: Mapping[str, str] = field(default_factory=dict)
    system_name: str = ""
    system_path: str = ""
    system_text: str = ""
    system_hash: str = ""
    run: str = ""
    seed: int | None = None
    horizon: int | None = None
    dt: float | None = None
    origin: int | None = None
    created: str = ""
    stlc_version: str = ""

    @property
    def planned(self) -> Carried:
        """The specification for which the control sequences (plans) were made."""
        return Carried(self.spec_name, self.spec_path, self.spec_text, self.spec_library, self.spec_set)

    @property
    def carried(self) -> Carried:
        """The specification that evaluates the trace.

        It is the second one (`judge_text`) if there is one, else `planned`.
        """
        if not self.judge_text:
            return self.planned
        return Carried("", self.judge_path, self.judge_text, self.judge_library, self.judge_set)

    def array(self, signature: Signature) -> NDArray[Any]:
        """Return metadata and signal descriptions as a JSON text in an array without axes.

        This is the inverse of `read_meta`.
        """
        signals = {column.name: _written(column) for column in signature.columns}
        return np.array(json.dumps(asdict(self) | {"signals": signals}))


def read_meta(path: Path, array: NDArray[Any] | None) -> tuple[TraceMeta, dict[str, Column]]:
    """Return the metadata in the array `meta` of a trace, and the descriptions of its signals.

    A description gives the unit, kind and range of a signal. Both results are empty if `array` is None.

    Raises:
        TraceError: E603, the array, a single text, is not JSON of the expected form.
    """
    if array is None:
        return TraceMeta(), {}
    try:
        written = loads(str(array))
        return _meta_of(written), {n: _column(n, entry) for n, entry in written.get("signals", {}).items()}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        raise unreadable(path, f"`meta` is damaged ({str(error)[:80]})") from None


def _meta_of(written: Mapping[str, Any]) -> TraceMeta:
    known: dict[str, Any] = {}
    for declared in fields(TraceMeta):
        if (name := declared.name) not in written:
            continue
        value = known[name] = written[name]
        if not isinstance(value, _TYPES[str(declared.type)]) or isinstance(value, bool):
            raise ValueError(f"`{name}` is {value!r:.40}")
        if isinstance(value, dict) and not all(isinstance(text, str) for text in value.values()):
            raise ValueError(f"`{name}` does not hold texts")
        if isinstance(value, (int, float)) and not abs(value) < 2**63:
            raise ValueError(f"`{name}` is out of range")
    return TraceMeta(**known)


def _column(name: str, entry: Mapping[str, Any]) -> Column:
    kind, role = entry.get("kind", "real"), entry.get("role", "state")
    if kind not in get_args(Kind) or role not in get_args(Role):
        raise ValueError(f"`{name}` is {kind!r:.20} {role!r:.20}")
    labels = tuple((label, _number(label, value)) for label, value in entry.get("labels", {}).items())
    unit = Unit.parse(entry["unit"]) if entry.get("unit") else Unit.ONE
    low, high = (None if entry.get(end) is None else _number(end, entry[end]) for end in ("low", "high"))
    return Column(name, unit, kind, role, low, high, labels)


def _number(name: str, value: Any) -> float:
    """Convert a JSON number. Raises ValueError for NaN and other values, OverflowError for a huge integer."""
    if not isinstance(value, (int, float)) or isinstance(value, bool) or value != value:
        raise ValueError(f"`{name}` is {value!r:.40}")
    return float(value)


def _written(column: Column) -> dict[str, Any]:
    entry: dict[str, Any] = {"kind": column.kind, "role": column.role}
    if column.unit.text:
        entry["unit"] = column.unit.text
    entry |= {key: value for key in ("low", "high") if (value := getattr(column, key)) is not None}
    if column.labels:
        entry["labels"] = dict(column.labels)
    return entry
