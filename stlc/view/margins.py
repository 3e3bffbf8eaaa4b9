"""The least margins of the agents that a scene shows, over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stlc.monitor.verdict import Monitor, Verdict
from stlc.trace import Trace
from stlc.view.driven import margins_of, monitor_of, units_of
from stlc.view.strip import Strip

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ENOUGH = 0.4
"""The least share of instants from which the world did for somebody as the model says, to show only those."""
AS_FORESEEN = "least margin from each instant on, of the agents for which the world did as the model says"


@dataclass(frozen=True, slots=True)
class Judged:
    """What the agents of a scene drove, those of the first seed, and the verdict on it.

    Attributes:
        trace: theirs.
        monitor: what judged it by the specification that plans are made for.
        verdict: by it.
        drove: the verdict by the rules of drives, where the trace carries them; else the same.
        foreseen: from which samples on the world did as the model says, (agents, samples); None: not known.
    """

    trace: Trace
    monitor: Monitor
    verdict: Verdict
    drove: Verdict
    foreseen: Mask | None

    @property
    def marked(self) -> set[str]:
        """Whose violations a picture marks: all rules of drives, else what is tagged `@safety`, if any is."""
        names = {judgement.name for judgement in self.drove if "safety" in judgement.rule.tags}
        ruled = bool(self.trace.meta.judge_text)
        return names if names and not ruled else {judgement.name for judgement in self.drove}


def judged_in(trace: Trace, agents: int, *, system: Path) -> Judged:
    """The first `agents` of a trace, judged by the specification that it carries.

    Raises:
        StlcError: the trace cannot be judged.
    """
    first = {name: values[:agents] for name, values in trace.data.items()}
    monitor, seen = monitor_of(trace, system=system), replace(trace, data=first, extras={})
    verdict = drove = monitor.check(seen)
    if trace.meta.judge_text:
        drove = monitor_of(trace, system=system, drives=True).check(seen)
    return Judged(seen, monitor, verdict, drove, as_foreseen(trace, agents))


def strip_of(judged: Judged, decisions: NDArray[np.int64] | None) -> Strip:
    """What is shown over time, with who decided, (frames, agents)."""
    trace, verdict = judged.trace, judged.verdict
    rows, units = margins_of(judged.monitor, verdict, trace), units_of(verdict)
    every = {name: least(rho) for name, rho in rows.items()}
    if judged.foreseen is not None:
        margins = {name: least(rho, judged.foreseen) for name, rho in rows.items()}
        if _known(margins) >= ENOUGH * _known(every):
            return Strip(trace.times, margins, decisions, AS_FORESEEN, units)
    return Strip(trace.times, every, decisions, units=units)


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
