"""Parts of a message by their names, such as `linear.x`, `position[elbow]` or `transforms[map/base].header`.

A message is a tree of dicts (its fields), sequences (arrays), numbers and texts. In brackets stands the
position of an element of an array, or its name: a text in it (`name`, `id`, `child_frame_id`, …), or the text
at its position in an array of names beside the array (`JointState`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

ARRAYS = (list, tuple, np.ndarray)
HEADER = "header"
NAMES = ("name", "names", "joint_names", "interface_names", "labels", "keys", "key")
"""Arrays of texts that name the elements of arrays beside them."""
PARENT, CHILD = "parent_frame_id", "child_frame_id"
NAMED = ("name", "id", "label", "key")
"""Fields that name the element that contains them, beside its frames."""
OMITTED = ("data", "transform")
"""Fields that names may omit: `tf[map/base].translation.x`. So may they arrays, before a bracket."""

_IDENTIFYING = frozenset((HEADER, PARENT, CHILD, *NAMES, *NAMED))
_STEP = re.compile(r"\[[^\]]*\]|\.?[^.\[]+")

Enclosing: TypeAlias = "tuple[Mapping[str, Any], Enclosing] | None"
"""The dicts around a part, the innermost first."""
Way: TypeAlias = "tuple[str, ...]"


class RefusedError(Exception):
    """Error: a part of a message that is asked for has no value, for a reason that continues "`name` …"."""


class Path:
    """Name of a part of the messages of a topic.

    Attributes:
        text: the name, without the topic.
        steps: its fields, and elements in brackets.
        keys: the elements that are addressed by their names.
        element: name of the innermost of them; "".
        moved: text that says that the name of an element at a position changes; "".
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self.steps = tuple(_STEP.findall(text))
        self.keys = tuple(each for each in self.steps if each[0] == "[" and not each[1:-1].isdecimal())
        self.element = "".join(text.rpartition(self.keys[-1])[:2]) if self.keys else ""
        self.moved = ""
        self._addressed: dict[int, str] = {}
        # fields that each step may mean, with the number of the step after it: keys may hold dots
        self._fields: list[list[tuple[str, int]]] = []
        for at, step in enumerate(self.steps):
            if step[0] == "[":
                fields = [(step[1:-1], at + 1)]
            else:
                ends = range(at + 1, len(self.steps) + 1)
                fields = [("".join(self.steps[at:end]).removeprefix("."), end) for end in ends]
            self._fields.append(fields)

    def find(self, tree: object) -> list[object]:
        """Return the part of a message, or [] if the message lacks it.

        Raises RefusedError if several parts have this name.
        """
        found = list(self._find(tree, 0, None, ()))
        if len(found) > 1:
            ways = " or ".join(f"`[{']['.join(way)}]`" for way, _ in found)
            raise RefusedError(f"may be {ways} of a message: write the one that is meant, with its brackets")
        return [value for _, value in found]

    def _find(self, node: object, at: int, above: Enclosing, way: Way) -> Iterator[tuple[Way, object]]:
        if at == len(self.steps):
            yield way, node
        elif isinstance(node, dict):
            keys = [each for each in self._fields[at] if each[0] in node]
            if not keys:
                near = node if self.steps[at][0] == "[" else OMITTED
                keys = [(n, at) for n in near if n in node and (n in OMITTED or _structures(node[n]))]
            for key, after in keys:
                yield from self._find(node[key], after, (node, above), (*way, key))
        elif isinstance(node, ARRAYS) and self.steps[at][0] == "[":
            for i in self._positions(node, at, above):
                yield from self._find(node[i], at + 1, above, (*way, str(i)))

    def _positions(self, node: Sequence[Any] | NDArray[Any], at: int, above: Enclosing) -> list[int]:
        """Position of the element that a step addresses in an array; [] if the array lacks it."""
        key, count = self.steps[at][1:-1], len(node)
        place = int(key[:9]) if key.isdecimal() else None
        near = range(count) if place is None else range(place, min(place + 1, count))
        labels = {i: element_names(node, i, above) for i in near}
        found = [i for i in near if place is not None or key in labels[i]]
        names = {labels[i][0] for i in found if labels[i]}
        if names:
            names.add(self._addressed.setdefault(at, min(names)))
        if len(names) > 1 and place is not None:
            part, one, other = (f"`{''.join(self.steps[:at])}[{each}]`" for each in (key, *sorted(names)[:2]))
            self.moved = self.moved or f"{part} is {one} in some messages, and {other} in others"
        elif len(found) > 1 or len(names) > 1:
            shown = ", ".join(f"`{each}`" for each in sorted(names))
            raise RefusedError(f"may be several elements of one array ({shown})")
        return found


def _structures(value: object) -> bool:
    return isinstance(value, (list, tuple)) and bool(value) and isinstance(value[0], dict)


def element_names(node: Sequence[Any] | NDArray[Any], i: int, above: Enclosing) -> list[str]:
    """Return the names of the element `i` of an array, the most precise one first."""
    each, found = node[i], []
    if isinstance(each, dict):
        child, head = each.get(CHILD), each.get(HEADER)
        if isinstance(child, str):
            parent = each.get(PARENT, head.get("frame_id") if isinstance(head, dict) else None)
            if isinstance(parent, str) and parent:
                found.append(f"{parent.strip('/')}/{child.strip('/')}")
            found.append(child.strip("/"))
        found += [str(each[label]) for label in NAMED if isinstance(each.get(label), (str, int))]
    while above is not None:
        beside, above = above
        for label in NAMES:
            names = beside.get(label)
            if not isinstance(names, (list, tuple)) or len(names) != len(node) or names is node:
                continue
            if isinstance(names[i], str):
                return [*found, names[i]]
    return found


@dataclass(frozen=True, slots=True)
class Selection:
    """The fields of a message that are decoded.

    Attributes:
        fields: each wanted field, by the names of the fields around it and its own; None: all.
        named: whether elements are addressed, so that fields that name them are needed too.
        long: whether long arrays are decoded.
    """

    fields: frozenset[tuple[str, ...]] | None = None
    named: bool = False
    long: bool = True

    @staticmethod
    def of(paths: Iterable[Path]) -> Selection:
        """Return the selection of the fields in some names."""
        steps = [path.steps for path in paths]
        fields = frozenset(tuple(n.removeprefix(".") for n in each if n[0] != "[") for each in steps)
        return Selection(None if () in fields else fields, any(n[0] == "[" for each in steps for n in each))

    def part(self, name: str, siblings: frozenset[str], *, nested: bool) -> Selection | None:
        """Return the selection within the field `name`; None if the field is not needed.

        A field that is not among its `siblings` may be in any of them that is a message itself (`nested`).
        """
        if self.fields is None:
            return self
        inner = [field[1:] for field in self.fields if field[0] == name]
        if () in inner or (self.named and name in _IDENTIFYING):
            return Selection()
        if nested:
            inner += [field for field in self.fields if field[0] not in siblings]
        return Selection(frozenset(inner), self.named) if inner else None


NOTHING = Selection(frozenset())
