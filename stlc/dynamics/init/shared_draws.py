"""Random numbers that several components of a vector read: drawn once, before the components."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import sampler_names
from stlc.dynamics.declaration.model import Assign
from stlc.dynamics.model.algebra import map_parts

_SAMPLERS = frozenset(sampler_names())


def shared_draws(assigns: Sequence[Assign]) -> tuple[Assign, ...]:
    """The assignments, with what a sampler gives to more than one of them drawn before, as a local name.

    `p: "uniform(0, 1) * [1, 2]"` names one random number; `p: "uniform(low, high)"` with vectors names one
    for each component.
    """
    if len(assigns) < 2:
        return tuple(assigns)
    readers = Counter(draw for assign in assigns for draw in _samplers(assign.value))
    shared = {draw for draw, count in readers.items() if count > 1}
    if not shared:
        return tuple(assigns)
    writer = _Writer(assigns[0].name, shared)
    changed = [replace(assign, value=writer.rewrite(assign.value)) for assign in assigns]
    return (*writer.before, *changed)


def _samplers(num: ir.Num) -> frozenset[int]:
    """Identities of the samplers in a number."""
    found: set[int] = set()
    seen: set[int] = set()

    def visit(part: ir.Num) -> ir.Num:
        if id(part) not in seen:
            seen.add(id(part))
            if isinstance(part, ir.Op) and part.name in _SAMPLERS:
                found.add(id(part))
            map_parts(part, visit)
        return part

    visit(num)
    return frozenset(found)


class _Writer:
    """Replaces shared samplers by names; `before` are their assignments, in order."""

    def __init__(self, prefix: str, shared: set[int]) -> None:
        self.before: list[Assign] = []
        self._prefix = prefix
        self._shared = shared
        self._known: dict[int, ir.Num] = {}

    def rewrite(self, num: ir.Num) -> ir.Num:
        """The number with shared samplers replaced."""
        if id(num) not in self._known:
            changed = map_parts(num, self.rewrite)
            if id(num) in self._shared:
                name = f"{self._prefix}#{len(self.before)}"
                self.before.append(Assign(name, changed))
                changed = ir.Signal(name)
            self._known[id(num)] = changed
        return self._known[id(num)]
