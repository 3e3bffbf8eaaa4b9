"""What happens to agents between steps, and what no planner foresees: the `events` of a system file."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stlc.compile.backends.array.arith import Program
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.switch import Hard
from stlc.dynamics.declaration.deployment import EventDecl
from stlc.dynamics.init.draws import Drawing, Rows

_CONDITION = "holds"


class _Event:
    """One declared event, ready to happen."""

    def __init__(self, decl: EventDecl) -> None:
        self.decl = decl
        self.draws = [Drawing(assign) for assign in decl.sets]
        self.when = Program({_CONDITION: ir.Indicator(decl.when)}) if decl.when is not None else None
        self.held: Tensor | None = None

    def fires(self, columns: dict[str, Tensor], step: int) -> Tensor:
        """For whom it happens now, (agents,) booleans."""
        like = next(iter(columns.values()))
        due = self.decl.at == step if self.decl.at is not None else True
        if self.decl.every is not None:
            due = due and step > 0 and step % self.decl.every == 0
        now = torch.full_like(like, due, dtype=torch.bool)
        if self.when is None:
            return now
        holds = torch.as_tensor(self.when(columns, TORCH, Hard())[_CONDITION] > 0.5).expand(len(like))
        before, self.held = self.held, holds
        match self.decl.edge:
            case "rise":
                return now & holds & ~before if before is not None else torch.zeros_like(now)
            case "fall":
                return now & ~holds & before if before is not None else torch.zeros_like(now)
            case _:
                return now & holds


class Events:
    """All events of a deployment; keeps what their edges have seen.

    Args:
        declared: in file order; later ones see what earlier ones set.
        names: columns of a state.
        dt: step in seconds.
    """

    def __init__(self, declared: Sequence[EventDecl], names: Sequence[str], dt: float) -> None:
        self._events = [_Event(decl) for decl in declared]
        self._names, self._dt = tuple(names), dt

    def apply(self, x: Tensor, step: int, generator: torch.Generator) -> tuple[Tensor, dict[str, int]]:
        """The (agents, n) states after the events of `step`, and how often each with a condition came."""
        columns = dict(zip(self._names, x.unbind(1), strict=True))
        counts: dict[str, int] = {}
        for event in self._events:
            columns["t"] = torch.full_like(x[:, 0], step * self._dt)
            mask = event.fires(columns, step)
            if event.when is not None:
                counts[event.decl.name] = int(mask.sum())
            if bool(mask.any()):
                drawn = dict(columns)
                for draw in event.draws:
                    drawn[draw.name] = draw(drawn, Rows(len(x), generator)).to(x)
                columns |= {name: torch.where(mask, drawn[name], columns[name]) for name in self._names}
        return torch.stack([columns[name] for name in self._names], 1), counts
