"""Variables in a MATLAB `.mat` file; files of version 7.3 are HDF5 and need the extra `mat`.

The field `x` of a structure `s` is called `s.x`, the second element of a cell array or a structure array `c`
is `c[1]`, and the columns of a matrix (samples, k) are the components of a vector. In what Simulink logs, the
names of signals count too: `logsout.speed.Data`, `logsout.speed` and `speed` are the data of the element with
the name speed, `ScopeData.speed` and `speed` those of the signal with this label.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from stlc.extras import needed
from stlc.trace.formats.arrays import Array, Arrays
from stlc.trace.formats.mat4 import mat4_kind, modelica, read_mat4
from stlc.trace.formats.mat5 import MAX_NODES, Mat5, Node, Variable
from stlc.trace.formats.registry import MAX_BYTES, damage, opened, room_for, unreadable
from stlc.trace.recording import ALL, ClockGroup, Recording, Wanted

_HDF5 = b"\x89HDF\r\n\x1a\n"
_RATIO = 1100
"""Limit on the compression ratio: more than deflate can reach."""
_DEEPEST = 16
_MAX_NAMES = 8
"""Most names of one array."""
_DATA = ("Data", "data", "values", "Values")
"""Fields that hold the samples of a logged signal."""
_WITHIN = re.compile(r"(\.signals)?(\[\d+\])?$")
"""End of the place of a logged signal that its name replaces."""
_OTHER = "external data"
_CONVERTED = {
    "timeseries": "t = {0}.Time; v = {0}.Data",
    "timetable": "t = seconds({0}.Properties.RowTimes - {0}.Properties.RowTimes(1)); "
    "s = table2struct(timetable2table({0}, 'ConvertRowTimes', false), 'ToScalar', true)",
    "table": "s = table2struct({0}, 'ToScalar', true)",
    "string": "s = cellstr({0})",
    "categorical": "s = cellstr({0})",
    "datetime": "t = posixtime({0})",
    "duration": "t = seconds({0})",
    "Simulink.SimulationData.Dataset": "t = {0}{{1}}.Values.Time; v = {0}{{1}}.Values.Data",
    "sparse": "v = full({0})",
    "complex": "re = real({0}); im = imag({0})",
    "function_handle": "v = {0}(t)",
    _OTHER: "v = {0}",
}
"""Kind of value that is not plain -> MATLAB's line that makes plain arrays of it; `{0}` is its name there."""


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read the wanted variables. Raises UsageError (U102), MissingError (R301) or TraceError (E603)."""
    with opened(path), path.open("rb") as file:
        head = file.read(520)
    if path.stat().st_size > MAX_BYTES:
        raise unreadable(path, f"it is larger than {MAX_BYTES / 1e9:.0f} GB", advice="split it")
    with damage(path):
        workspace = _Workspace(path, wanted)
        if _HDF5 in (head[:8], head[512:520]):
            with needed("h5py").File(path, "r") as file:
                return workspace.recording(_Hdf5(path, file).variables())
        if mat4_kind(head):
            simulated = modelica(path, wanted) if head[20:27] == b"Aclass\0" else None
            return simulated or workspace.recording(read_mat4(path))
        if head[126:128] in (b"IM", b"MI"):
            return workspace.recording(Mat5(path).variables())
    what = "it is empty" if not head else "it is not a MATLAB file of version 4, 5 or 7.3"
    raise unreadable(path, what, advice="save it in MATLAB with  save FILE -v7")


@dataclass(frozen=True, slots=True)
class _Place:
    """Place of a value in a workspace, with the place and the number of the times of its samples."""

    names: tuple[str, ...]
    matlab: str
    clock: str = ""
    samples: int = 0
    depth: int = 0

    @property
    def shown(self) -> str:
        """The name that is used if none is asked for."""
        return self.names[:2][-1]

    def inside(self, name: str, matlab: str, also: Sequence[str] = ()) -> _Place:
        """Place of an element or a field, which may have more names."""
        names = (*(each + name for each in self.names), *also)
        return replace(self, names=names[:_MAX_NAMES], matlab=self.matlab + matlab, depth=self.depth + 1)

    def by_samples(self, values: Array) -> Array:
        """Return the values of a logged signal with the samples as the first axis."""
        if values.ndim < 2 or self.samples < 2 or self.samples not in (values.shape[0], values.shape[-1]):
            return values
        if values.ndim > 2 or values.shape[0] != self.samples:
            values = values.reshape(-1, values.shape[-1], order="F").T
        return values[None] if values.shape[0] == values.shape[1] else values  # rows could be traces


def _text(node: Node | None) -> str:
    return "".join(node.values()[:1].tolist()) if node and node.text else ""


class _Workspace:
    """Variables of a file, and what is kept of them."""

    def __init__(self, path: Path, wanted: Wanted) -> None:
        self.path, self.wanted, self.found = path, wanted, Arrays(wanted)
        asked = (*(wanted.names or ()), wanted.clock, *wanted.groups)
        self.asked = {*asked, *(name.rpartition("[")[0] for name in asked)}
        self.leaves: list[tuple[_Place, Node]] = []
        self.nodes = 0

    def recording(self, variables: Iterable[Variable]) -> Recording:
        """Read the variables. If the file is damaged, those before the damage count."""
        every: list[Variable] = []
        broken: Exception | None = None
        try:
            every.extend(islice(variables, MAX_NODES))
        except Exception as error:
            broken = error
        for each in every:
            if self.wanted.keeps(each.name):
                self._open(each)
            else:
                self.found.note(each.name)
        for each in every if self._missing() else ():  # signals have names without those of variables
            if each.nested and not self.wanted.keeps(each.name):
                self._open(each)
        if broken:
            if not every or self.wanted.names is None or self._missing():
                raise broken
            where = f"`{self.path}` is damaged or cut short behind `{every[-1].name}`"
            self.found.remarks.append(f"{where}, the rest was not read: {broken}")
        return self.found.recording(self.path, self._groups())

    def _count(self, values: int) -> None:
        self.nodes += values
        if self.nodes > MAX_NODES:
            raise ValueError("too many values")

    def _missing(self) -> bool:
        known = {name for place, _ in self.leaves for name in place.names} | self.found.refused.keys()
        return any(known.isdisjoint((name, name.rpartition("[")[0])) for name in self.wanted.names or ())

    def _open(self, variable: Variable) -> None:
        before = len(self.leaves)
        try:
            self._walk(variable.node(), _Place((variable.name,), variable.name))
        except Exception:
            if self.wanted.reads(variable.name):
                raise
            del self.leaves[before:]

    def _walk(self, node: Node, place: _Place) -> None:
        if place.depth > _DEEPEST:
            raise ValueError("values are nested too deeply")
        if node.kind:
            line = _CONVERTED.get(node.kind, "s = struct({0})").format(place.matlab)
            why = f"is `{node.kind}` in MATLAB, not numbers; convert it there with  {line}; save FILE "
            for name in place.names:
                self.found.refuse(name, why + " ".join((*re.findall(r"(\w+) = ", line), "-v7")))
        cells = list(islice(node.cells, MAX_NODES))
        self._count(len(cells))
        if len(cells) > 1 and all(cell.single for cell in cells):
            texts = np.array([_text(cell) for cell in cells])
            node, cells = Node(texts.shape, lambda: texts), []
        if node.load:
            self.leaves.append((place, node))
        for i, cell in enumerate(cells):
            self._walk(cell, place.inside(f"[{i}]", f"{{{i + 1}}}"))
        many = math.prod(node.shape) > 1
        for i, fields in enumerate(node.fields):
            self._count(1 + len(fields))
            self._walk_fields(fields, place.inside(f"[{i}]", f"({i + 1})") if many else place)

    def _walk_fields(self, fields: Mapping[str, Node], place: _Place) -> None:
        """Collect the arrays of a structure; the data of a logged signal have the names of the signal too."""
        title = _text(fields.get("Name" if "Values" in fields else "label" if "values" in fields else ""))
        also = [f"{_WITHIN.sub('', place.names[0])}.{title}", title] if title else []
        for field, node in fields.items():
            if field.lower() == "time" and node.load and (samples := math.prod(node.shape)) > 1:
                place = replace(place, clock=f"{place.names[0]}.{field}", samples=samples)
                also += place.names
        for field, node in fields.items():
            self._walk(node, place.inside(f".{field}", f".{field}", also if field in _DATA else []))

    def _groups(self) -> list[ClockGroup]:
        """Decode the arrays that are kept; a structure with times makes a group of its own."""
        groups, asked = dict[str, Arrays](), set[str]()
        for place, node, names in self._named():
            key = "" if self.wanted.clock else place.clock
            if names:
                asked.add(key)
            elif self.wanted.names is None or not self.found.takes(place.shown):
                continue
            try:
                values = place.by_samples(node.values())
            except Exception as error:
                if names:
                    raise ValueError(f"`{names[0]}`: {error}") from error
                continue
            for name in names or (place.shown,):
                groups.setdefault(key, replace(self.found, kept={})).add(name, values)
        return [ClockGroup(each.kept, None) for key, each in groups.items() if key in asked or not asked]

    def _named(self) -> Iterator[tuple[_Place, Node, Sequence[str]]]:
        """Yield the arrays with the names under which they are read; clashes are noted."""
        first = {place.names[0] for place, _ in self.leaves}
        owners = Counter(name for place, _ in self.leaves for name in set(place.names))
        for place, node in self.leaves:
            where, *more = place.names
            free = [where, *(name for name in more if name not in first and owners[name] == 1)]
            for name in self.asked.intersection(more).difference(free, first):
                self.found.clashes.setdefault(name, {})[where] = where
            names = [name for name in free if name in self.asked]
            if self.wanted.names is None and not node.single:
                names = [place.shown if place.shown in free else where]
            yield place, node, names


# ---------------------------------------------------------------------- version 7.3


class _Hdf5:
    def __init__(self, path: Path, file: Any) -> None:
        self.file, self.room, self.h5py = file, room_for(path), needed("h5py")

    def variables(self) -> Iterator[Variable]:
        for name in self._members(self.file):
            if not name.startswith("#"):
                yield Variable(name, True, partial(self._node, self.file, name))

    def _members(self, group: Any) -> Iterator[str]:
        return (n for n in group if isinstance(group.get(n, getlink=True), self.h5py.HardLink))

    def _node(self, group: Any, key: Any) -> Node:
        item = group[key] if key else None
        if item is None or item.attrs.get("MATLAB_empty", 0):
            return Node()
        kind = item.attrs.get("MATLAB_class", b"double")
        kind = kind.decode("latin-1") if isinstance(kind, bytes) else str(kind)
        if "MATLAB_sparse" in item.attrs:
            return Node(kind="sparse")
        if "MATLAB_object_decode" in item.attrs or kind == "function_handle":
            return Node(kind=kind[:60])
        if isinstance(item, self.h5py.Group):
            parts: dict[str, list[tuple[Any, Any]]] = {}
            for field in self._members(item):
                child, parts[field] = item[field], [(item, field)]
                if self._refers(child) and "MATLAB_class" not in child.attrs:  # those of a structure array
                    parts[field] = [(self.file, each) for each in self._values(child).ravel("F")]
            count = max(map(len, parts.values()), default=0)
            each = ({f: self._node(*p[i]) for f, p in parts.items() if i < len(p)} for i in range(count))
            return Node((count,), fields=each)
        shape, plain = item.shape[::-1], item.dtype.kind in "biuf" or item.dtype.names == ("real", "imag")
        if self._refers(item):
            return Node(shape, cells=(self._node(self.file, r) for r in self._values(item).ravel("F")))
        if not plain or item.is_virtual or item.external:
            return Node(kind=_OTHER)
        return Node(shape, partial(self._values, item, logical=kind == "logical"), text=kind == "char")

    def _refers(self, item: Any) -> bool:
        return isinstance(item, self.h5py.Dataset) and self.h5py.check_ref_dtype(item.dtype) is not None

    def _values(self, dataset: Any, *, logical: bool = False) -> Array:
        each = 200 if dataset.dtype.hasobject else dataset.dtype.itemsize  # a reference becomes an object
        size = int(np.prod(dataset.shape, dtype=np.float64)) * each
        if size > self.room or size > _RATIO * dataset.id.get_storage_size() + 1024:
            raise ValueError(f"it declares {size / 1e9:.3g} GB that the file does not hold")
        self.room -= size
        values = np.asarray(dataset[()]).T
        if values.dtype.names is not None:
            values = values["real"] + 1j * values["imag"]
        return values.astype(bool) if logical else values
