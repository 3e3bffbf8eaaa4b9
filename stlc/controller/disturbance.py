"""What a scenario adds to the truth, and to what agents see of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from stlc.dynamics.draws import Drawing, Rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from stlc.dynamics.decl import Assign
    from stlc.dynamics.system import System


class Disturbance:
    """The `disturb` and `noise` of the scenario of a system; nothing without one.

    Both read the state at hand and the time `t` of the deployment, and may draw.
    """

    def __init__(self, system: System, generators: Sequence[torch.Generator], agents: int) -> None:
        scenario = system.decl.scenario
        self._names, self._dt = system.decl.signature.names, system.dt
        self._scale = 1.0 if system.decl.discrete else system.dt
        self._clamps = system.decl.clamps
        self._generators, self._agents = generators, agents
        self._pushes = _drawings(scenario.disturb if scenario else ())
        self._noises = _drawings(scenario.noise if scenario else ())

    def pushed(self, x: Tensor, before: Tensor, step: int) -> Tensor:
        """The (rows, n) states after a step that began in `before` at time `(step - 1) dt`, disturbed."""
        if not self._pushes:
            return x
        added = self._drawn(self._pushes, before, step - 1)
        return self._changed(x, {name: self._scale * value for name, value in added.items()}, clamped=True)

    def seen(self, x: Tensor, step: int) -> Tensor:
        """What agents see of (rows, n) states; columns behind those of the system are as they are."""
        if not self._noises:
            return x
        return self._changed(x, self._drawn(self._noises, x, step), clamped=False)

    def _drawn(self, drawings: Sequence[Drawing], x: Tensor, step: int) -> dict[str, Tensor]:
        """Values for all rows, those of each seed from its own generator."""
        parts = []
        for rows, generator in zip(torch.split(x, self._agents), self._generators, strict=True):
            table = dict(zip(self._names, rows.double().unbind(1), strict=False))
            table["t"] = torch.full_like(table[self._names[0]], step * self._dt)
            found: dict[str, Tensor] = {}
            for drawing in drawings:
                found[drawing.name] = drawing({**found, **table}, Rows(len(rows), generator))
            parts.append(found)
        return {drawing.name: torch.cat([part[drawing.name] for part in parts]) for drawing in drawings}

    def _changed(self, x: Tensor, added: dict[str, Tensor], *, clamped: bool) -> Tensor:
        columns = list(x.unbind(1))
        for index, name in enumerate(self._names):
            if name in added:
                columns[index] = columns[index] + added[name].to(x)
                if clamped and name in self._clamps:
                    columns[index] = columns[index].clamp(*self._clamps[name])
        return torch.stack(columns, 1)


def _drawings(assigns: Sequence[Assign]) -> tuple[Drawing, ...]:
    return tuple(Drawing(assign) for assign in assigns)
