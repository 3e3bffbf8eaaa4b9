"""Drivers for the traffic grid that need no training."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

Driver = Callable[[Tensor], Tensor]

CRUISE = 5.0
BRAKE = 10.0
DT = 0.1


def careful(x: Tensor) -> Tensor:
    """The fastest acceleration after which full braking still keeps every rule; (cars, 7) -> (cars, 1)."""
    at, v, sign, tau, dx, v_lead, yielding = x.T.numpy()
    light, red = sign > 0.5, tau <= 4.0
    room = np.full(len(x), np.inf)
    must_stop = ~light & ((yielding > 0.5) | (tau < 1.05))
    room = np.where(must_stop, np.minimum(room, -0.55 - at), room)
    travel = CRUISE * (8.0 - tau - DT) - (CRUISE - v) ** 2 / (2 * BRAKE)
    passes = at + travel > 0.05
    waits = light & (red | ~passes) & ~(red & (at > -1.0))
    room = np.where(waits, np.minimum(room, -1.0 - at), room)
    behind = dx - 1.1 + np.maximum(v_lead - BRAKE * DT, 0.0) ** 2 / (2 * BRAKE)
    room = np.where(dx >= 0.0, np.minimum(room, behind), room)
    speeds = np.linspace(0.0, CRUISE, 101)[:, None]
    reachable = np.abs(speeds - v) <= BRAKE * DT + 1e-9
    stopping = v * DT + speeds**2 / (2 * BRAKE) + speeds * DT / 2 + 0.02
    good = reachable & (stopping <= room)
    slowest = np.maximum(v - BRAKE * DT, 0.0)
    chosen = np.where(good.any(0), np.where(good, speeds, -1.0).max(0), slowest)
    return torch.from_numpy((chosen - v) / DT)[:, None]


def reckless(seed: int) -> Driver:
    """Random accelerations, more often forwards."""
    generator = torch.Generator().manual_seed(seed)
    return lambda x: torch.rand(len(x), 1, generator=generator, dtype=torch.float64) * 20 - 9
