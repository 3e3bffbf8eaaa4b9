"""Observation and action spaces of a task, physical or normalised to [-1, 1], with their conversions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.ir.ranges import bounds
from stlc.controller.problem.task import Task
from stlc.diagnostics import usage

Floats: TypeAlias = NDArray[np.float32]

PROBED = 256
"""Random plans whose observations widen the bounds of the space."""


@dataclass(frozen=True, slots=True)
class SpaceBounds:
    """Bounds of a space, (k,) float32, with the conversion between physical and normalised values."""

    low: Floats
    high: Floats

    @classmethod
    def of(cls, ranges: Sequence[tuple[float, float]]) -> SpaceBounds:
        """Bounds from pairs (low, high)."""
        ends = np.array(ranges, dtype=np.float32).reshape(-1, 2)
        return cls(ends[:, 0].copy(), ends[:, 1].copy())

    def space(self, *, unit: bool) -> Any:
        """Gymnasium space of vectors (k,) within the bounds; from -1 to 1 if `unit`."""
        if unit:
            return Box(-1.0, 1.0, self.low.shape, dtype=np.float32)
        return Box(self.low, self.high, dtype=np.float32)

    def physical(self, given: NDArray[np.float32], *, unit: bool) -> NDArray[np.float64]:
        """Convert values (…, k) to physical units and clip them to the bounds.

        `unit`: whether the given values are normalised to [-1, 1]. Raises UsageError (U101) for NaN.
        """
        low, high = self.low.astype(np.float64), self.high.astype(np.float64)
        value = np.asarray(given, dtype=np.float64)
        if np.isnan(value).any():
            place = tuple(map(int, np.argwhere(np.isnan(value))[0]))
            raise usage(f"the action is NaN at index {', '.join(map(str, place))}", "give finite actions")
        return np.clip(low + 0.5 * (value + 1.0) * (high - low) if unit else value, low, high)

    def shown(self, value: NDArray[np.float32], *, unit: bool) -> Floats:
        """Clip physical values (…, k) to the bounds; if `unit`, normalise them to [-1, 1]."""
        if not unit:
            return np.clip(value, self.low, self.high)
        factor = 2.0 / (self.high - self.low)
        scaled: Floats = value * factor
        scaled -= self.low * factor + 1.0
        return np.clip(scaled, -1.0, 1.0, out=scaled)


def of_actuators(task: Task) -> SpaceBounds:
    """Bounds of the actuator commands, in physical units."""
    return SpaceBounds.of(task.system.actuators)


def of_observation(task: Task, *, time: bool) -> SpaceBounds:
    """Bounds of the observed values, in physical units.

    They cover the nominal ranges and the values that random plans reach, widened by a quarter at each end. If
    `time`, the elapsed share of the episode, from 0 to 1, is the last observed value.
    """
    system = task.system
    generator = torch.Generator().manual_seed(0)
    x0 = task.sample(PROBED, seed=0, dtype=torch.float64)
    low, high = system.control_low.double(), system.control_high.double()
    shape = (PROBED, task.horizon, len(low))
    plans = low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)
    seen = system.observe(system.rollout(x0, plans)).flatten(0, 1)
    facts = {
        each.name: (each.low, each.high)
        for each in system.signature.columns
        if each.low is not None and each.high is not None
    }
    found = []
    for number, column in zip(system.observed, seen.unbind(1), strict=True):
        ends = bounds(number, facts) or (math.inf, -math.inf)
        least, most = min(ends[0], float(column.min())), max(ends[1], float(column.max()))
        if not math.isfinite(most - least):
            least, most = float(column.min()), float(column.max())
        # also by several numbers of float32: bounds that are equal there have no normalised values between
        wider = max(0.25 * max(most - least, 1e-3), 1e-6 * max(abs(least), abs(most)))
        found.append((least - wider, most + wider))
    return SpaceBounds.of([*found, *([(0.0, 1.0)] if time else [])])


def initial_state(task: Task, given: object, count: int) -> Tensor:
    """Initial states from the option `state` of `reset`, (count, n) float64.

    The option is one state (n,) for all environments, or one per environment, (count, n). Raises UsageError
    (U101) if its shape or a value is wrong.
    """
    width = len(task.system.names)
    x = torch.as_tensor(np.array(given, dtype=np.float64))
    if x.shape not in ((width,), (count, width)) or not bool(torch.isfinite(x).all()):
        raise usage(
            f"the option `state` has the shape {tuple(x.shape)} or is not finite",
            f"give {width} numbers: {', '.join(task.system.names)}",
        )
    return x.expand(count, width).contiguous()
