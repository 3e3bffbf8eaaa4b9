"""Drivers for the traffic grid that need no training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

Driver = Callable[[Tensor], Tensor]

CRUISE = 5.0
BRAKE = 10.0
DT = 0.1


def careful(x: Tensor) -> Tensor:
    """The fastest acceleration after which full braking still keeps every rule; (cars, 7) -> (cars, 1)."""
    return _drive(x, _How())


@dataclass(frozen=True)
class _How:
    blind: bool = False
    reds: bool = True
    yields: bool = True
    stay: float = 1.05
    creep: float = 0.0
    lazy: bool = False


def driver(**how: Any) -> Driver:
    """The careful one but for a fault.

    Args:
        how: `blind`: sees no car; `reds=False`: no light; `yields=False`: not that it has to yield; `stay`:
            so many seconds at a stop sign; `creep`: without standing there, at so many m/s; `lazy`: once it
            stands it never gets on.
    """
    return lambda x: _drive(x, _How(**how))


def _drive(x: Tensor, how: _How) -> Tensor:
    at, v, sign, tau, dx, v_lead, yielding = x.T.numpy()
    light, red = sign > 0.5, tau <= 4.0
    room = np.full(len(x), np.inf)
    must_stop = ~light & ((yielding > 0.5) & how.yields | (tau < how.stay))
    room = np.where(must_stop, np.minimum(room, -0.55 - at), room)
    travel = CRUISE * (8.0 - tau - DT) - (CRUISE - v) ** 2 / (2 * BRAKE)
    passes = at + travel > 0.05
    waits = light & (red | ~passes) & ~(red & (at > -1.0)) & how.reds
    room = np.where(waits, np.minimum(room, -1.0 - at), room)
    behind = dx - 1.1 + np.maximum(v_lead - BRAKE * DT, 0.0) ** 2 / (2 * BRAKE)
    room = np.where((dx >= 0.0) & (not how.blind), np.minimum(room, behind), room)
    speeds = np.linspace(0.0, CRUISE, 101)[:, None]
    reachable = np.abs(speeds - v) <= BRAKE * DT + 1e-9
    stopping = v * DT + speeds**2 / (2 * BRAKE) + speeds * DT / 2 + 0.02
    good = reachable & (stopping <= room)
    slowest = np.maximum(v - BRAKE * DT, 0.0)
    chosen = np.where(good.any(0), np.where(good, speeds, -1.0).max(0), slowest)
    slow = ~light & (at >= -1.5) & (how.creep > 0.0)
    chosen = np.where(slow, np.maximum(chosen, np.minimum(how.creep, chosen)), chosen)
    chosen = np.where(slow, np.clip(chosen, slowest, np.maximum(how.creep, slowest)), chosen)
    chosen = np.where((v < 0.05) & how.lazy, 0.0, chosen)
    return torch.from_numpy((chosen - v) / DT)[:, None]


def reckless(seed: int) -> Driver:
    """Random accelerations, more often forwards."""
    generator = torch.Generator().manual_seed(seed)
    return lambda x: torch.rand(len(x), 1, generator=generator, dtype=torch.float64) * 20 - 9
