"""Violations as events: which requirement, by whom, at which instant, judged in which window, and why."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stlc.monitor.explain.report import explain_at
from stlc.monitor.judgement import Judgement, Verdict

MOST = 240
"""Events of one requirement that are looked for."""
FLASH = (True, True, True, False)
"""How a mark comes and goes, frame by frame."""
FLASHES = 4


@dataclass(frozen=True, slots=True)
class Event:
    """What one agent violated once.

    Attributes:
        requirement: its name.
        agent: number of the trace.
        sample: of the violation.
        until: the last sample of violations that follow one another without a gap.
        start: first sample of the window in which it was judged.
        because: one line in words.
    """

    requirement: str
    agent: int
    sample: int
    until: int
    start: int
    because: str


def events_of(verdict: Verdict, agents: int, *, most: int = MOST) -> list[Event]:
    """The violations by the first `agents` traces, in the order of time.

    A violation is at the instant that explains it. Windows that begin behind that instant are looked at anew,
    so that each instant is found once; at most `most` for a requirement.
    """
    found: list[Event] = []
    for judgement in verdict:
        own: list[Event] = []
        for agent in range(min(agents, verdict.traces)):
            own += _events(verdict, judgement, agent, most - len(own))
        found += own
    return sorted(found, key=lambda event: (event.sample, event.agent))


def _events(verdict: Verdict, judgement: Judgement, agent: int, most: int) -> list[Event]:
    if judgement.scope is not None and not judgement.scope[agent]:
        return []
    starts = judgement.start + np.flatnonzero(judgement.fails[:, agent])
    found: list[Event] = []
    while len(starts) and len(found) < most:
        start = int(starts[0])
        cause = explain_at(verdict, judgement.name, agent, start)
        if found and cause.sample <= found[-1].until + 1:
            found[-1] = replace(found[-1], until=max(cause.sample, found[-1].until))
        else:
            found.append(Event(judgement.name, agent, cause.sample, cause.sample, start, cause.because))
        starts = starts[starts > max(start, cause.sample)]
    return found


def marks(
    events: Iterable[Event], frames: int, agents: int, names: Collection[str] | None = None
) -> NDArray[np.bool_]:
    """Whom a picture marks when, (frames, agents): from a violation on for a moment, coming and going.

    Args:
        events: violations.
        frames: instants of the film.
        agents: that are seen.
        names: requirements that count; None: all.
    """
    shown = np.zeros((frames, agents), dtype=bool)
    pattern = np.array(FLASH * FLASHES)
    for event in events:
        if event.agent < agents and (names is None or event.requirement in names):
            own = shown[event.sample : event.until + 1, event.agent]
            own[:] = True
            after = shown[event.until : event.until + len(pattern), event.agent]
            after |= pattern[: len(after)]
    return shown
