"""The least margins of the agents that a scene shows, over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stlc.trace import Trace
from stlc.view.driven import margins_of, monitor_of, units_of
from stlc.view.scene import Scene
from stlc.view.strip import Strip

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ENOUGH = 0.4
"""The least share of instants from which the world did for somebody as the model says, to show only those."""
AS_FORESEEN = "least margin from each instant on, of the agents for which the world did as the model says"


def strip_of(scene: Scene, trace: Trace, dt: float, *, system: Path) -> Strip | None:
    """What is shown over time of the agents of a scene, those of the first seed of a trace.

    None where the trace is of another deployment, or nobody recorded who decided.

    Raises:
        StlcError: the trace cannot be judged.
    """
    frames = min(len(values) for values in scene.values())
    decisions = scene.get("decision")
    if decisions is None or trace.samples != frames:
        return None
    times = np.arange(frames, dtype=np.float64) * np.float64(dt)
    shown = decisions.shape[1]
    first = {name: values[:shown] for name, values in trace.data.items()}
    monitor, seen = monitor_of(trace, system=system), replace(trace, data=first, extras={})
    verdict = monitor.check(seen)
    rows, units = margins_of(monitor, verdict, seen), units_of(verdict)
    counts = as_foreseen(trace, shown)
    every = {name: least(rho) for name, rho in rows.items()}
    if counts is not None:
        margins = {name: least(rho, counts) for name, rho in rows.items()}
        if _known(margins) >= ENOUGH * _known(every):
            return Strip(times, margins, decisions.astype(np.int64), AS_FORESEEN, units)
    return Strip(times, every, decisions.astype(np.int64), units=units)


def as_foreseen(trace: Trace, agents: int) -> Mask | None:
    """From which samples on the world did as the model says, for the length of a plan, (agents, samples).

    None where that was not recorded.
    """
    steps, horizon = trace.extras.get("foreseen"), trace.meta.horizon
    if steps is None or horizon is None or steps.shape != (trace.traces, trace.samples - 1):
        return None
    wrong = np.cumsum(np.pad(steps[:agents] == 0, ((0, 0), (1, horizon))), axis=1)
    return np.asarray(wrong[:, horizon : horizon + trace.samples] == wrong[:, : trace.samples])


def least(rho: Floats, counts: Mask | bool = True) -> Floats:
    """The least of the agents that count, (agents, samples) -> (samples,); NaN where none is known."""
    known = np.where(counts & ~np.isnan(rho), rho, np.inf).min(0)
    return np.where(np.isfinite(known), known, np.nan)


def _known(margins: Mapping[str, Floats]) -> int:
    """How many margins there are."""
    return sum(int(np.isfinite(rho).sum()) for rho in margins.values())
