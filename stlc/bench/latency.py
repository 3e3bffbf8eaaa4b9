"""`stlc bench latency`: how long a decision for one agent takes on one thread, without a guard and with each.

States are those of deployments under the paper's guard. Half of them are spread evenly over what was
visited; the others are states in which a guard had to act, because those are rare where a policy is good.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.bench.measure import one_thread
from stlc.controller.deployment.simulator import Recorder, Recording, Setting, drive
from stlc.controller.guard.guard import Guard, Mode
from stlc.controller.guard.plan_repair import Limits
from stlc.controller.training.run import Run
from stlc.controller.world import world_type

if TYPE_CHECKING:
    from stlc.rundir import RunDir

GUARDS: tuple[Mode, ...] = ("none", "paper", "full")
POLICY = "policy"
AGENTS = 5
WARM = 5


@dataclass(frozen=True, slots=True)
class Times:
    """Milliseconds of decisions.

    Attributes:
        median: of them.
        p99: 99th percentile.
        samples: how many.
    """

    median: float
    p99: float
    samples: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Times | None:
        """None of nothing."""
        if not seconds:
            return None
        median, p99 = np.quantile(1e3 * np.asarray(seconds), (0.5, 0.99))
        return cls(float(median), float(p99), len(seconds))


@dataclass(frozen=True, slots=True)
class Row:
    """One policy under one guard.

    Attributes:
        benchmark: name of the specification.
        run: of the policy.
        guard: which; `policy` for its plan, rollout and verdict alone.
        every: decisions in states that are spread evenly over what was visited.
        acting: decisions in which the guard replaced the policy's plan; None where it never did.
    """

    benchmark: str
    run: str
    guard: str
    every: Times | None
    acting: Times | None


def rows_of(folders: Iterable[RunDir], *, samples: int, seeds: Sequence[int]) -> Iterator[Row]:
    """Measure policies one after the other, a row for the policy alone and one for every guard."""
    with one_thread():
        for folder in folders:
            yield from _rows(Run.open(folder.path), samples, tuple(seeds))


def _rows(run: Run, samples: int, seeds: tuple[int, ...]) -> Iterator[Row]:
    task, test = run.task, run.task.system.decl.test
    guards = {mode: Guard(task, run.policy, mode, limits=Limits()) for mode in GUARDS}
    recorder = Recorder(min(AGENTS, test.agents))
    setting = Setting(seeds, recorder.agents, test.steps, test.replan)
    drive(guards["paper"], world_type(task.system.decl), setting, recorder)
    recording = recorder.recording()
    assert recording is not None
    even, acted = picked(recording, samples)
    yield Row(task.compiled.name, run.dir.name, POLICY, Times.of(_alone(run, recording, even)), None)
    for mode, guard in guards.items():
        every, there = _timed(guard, recording, even), _timed(guard, recording, acted)
        acting = [seconds for seconds, source in (*every, *there) if source]
        times = Times.of([seconds for seconds, _ in every])
        yield Row(task.compiled.name, run.dir.name, mode, times, Times.of(acting))


def picked(recording: Recording, samples: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places (row, step), half of them spread evenly, (k, 2), and half where the guard acted, (l, 2)."""
    half = max(samples // 2, 1)
    every = np.argwhere(np.ones_like(recording.source, dtype=bool))
    return _spread(every, half), _spread(np.argwhere(recording.source > 0), half)


def _spread(places: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    found: NDArray[np.int64] = places[np.linspace(0, len(places) - 1, min(count, len(places))).astype(int)]
    return found


def _alone(run: Run, recording: Recording, places: NDArray[np.int64]) -> list[float]:
    """Seconds of a plan of the policy, its rollout and its verdict."""
    found = []
    for row, step in (*places[:WARM], *places):
        x = torch.from_numpy(recording.states[row, step])[None]
        begin = perf_counter()
        run.plan_judged(x)
        found.append(perf_counter() - begin)
    return found[min(WARM, len(places)) :]


def _timed(guard: Guard, recording: Recording, places: NDArray[np.int64]) -> list[tuple[float, int]]:
    """Seconds of each decision, and who took it. The first few are taken twice: they warm the caches."""
    found = []
    for row, step in (*places[:WARM], *places):
        before, now = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        begun = guard.decide(before).later()
        begin = perf_counter()
        if recording.options is not None:
            guard.prefer(torch.from_numpy(recording.options[row, step])[None], begun)
        decision = guard.decide(now, begun)
        found.append((perf_counter() - begin, int(decision.source)))
    return found[min(WARM, len(places)) :]
