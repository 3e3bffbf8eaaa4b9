"""Closed-loop share of a trained policy: drives in the declared world without and with guards.

The accuracy of plans says little of what is driven: a plan is followed for a step and made anew, a guard
replaces it, and the world is not what training states are drawn from. So a policy is driven, from seeds that
neither training nor `simulate` uses by itself, and judged as `simulate` judges.

The dearer guards are driven only where the cheaper one leaves something to do, on the same starts; what time
is left goes to the guards that may turn out best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, Setting, SimulationStep, drive
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.evaluation.rules import Rules, drives_of_plans, obeying, rules_of, verdict_on_drives
from stlc.controller.guard.candidates import Limits, Mode
from stlc.controller.guard.guard import Guard
from stlc.controller.training.config import DRIVES
from stlc.controller.world import world_type
from stlc.diagnostics import StlcError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.controller.training.run import Run

SEED = 1 << 40
"""Seed of the first drives; those of `simulate` begin at 0."""
GUARDS: tuple[Mode, ...] = ("none", "paper", "full")
"""From the cheapest to the dearest."""
NARROW = 0.005
"""Half the width of an interval at which a share is known: small, so that drives take the time they have."""
NEAR = 0.02
"""Share by which a cheaper guard may be worse than the best one and still be recommended."""
LEAST = 20
"""Drives from which on a share is taken as it is."""
SURE = 0.9
"""Chance that a guard of fewer drives is better, from which on it is recommended."""
FEWER = 4
"""A seed whose drives take too long is driven with so many times fewer agents."""


@dataclass(frozen=True, slots=True)
class Share:
    """Closed-loop runs under one guard, counted.

    Attributes:
        guard: which.
        drives: how many, one agent over one seed each.
        satisfied: that satisfy the mission: the rules of the system (`test: judge`), else the specification.
        safe: that satisfy what is tagged `@safety` in it; None where nothing is.
        compared: drives that were made without a guard from the same starts, too.
        gained: of these, satisfied only with the guard.
        lost: of these, satisfied only without.
    """

    guard: Mode
    drives: int
    satisfied: int
    safe: int | None
    compared: int = 0
    gained: int = 0
    lost: int = 0

    @property
    def share(self) -> float:
        """Of the drives that satisfy the mission."""
        return self.satisfied / self.drives

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % Wilson interval of the share."""
        return wilson(self.share, self.drives)

    def better_than(self, other: Share) -> bool:
        """True where it is worth its cost: better by more than `NEAR`, and surely so where drives are few."""
        better = self.share > other.share + NEAR
        return better and (self.drives >= LEAST or _superiority(self, other, NEAR) >= SURE)

    def summary(self) -> dict[str, object]:
        """For JSON documents."""
        safe = None if self.safe is None else self.safe / self.drives
        return {
            "guard": self.guard,
            "drives": self.drives,
            "satisfied": self.satisfied,
            "share": self.share,
            "interval": list(self.interval),
            "safe": safe,
            "compared": self.compared,
            "gained": self.gained,
            "lost": self.lost,
        }


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """Closed-loop runs after a training.

    Attributes:
        shares: under each guard that was driven, the cheapest first; none where no drive came to its end.
        steps: of a drive.
        judge: the specification that drives were judged by; None for that of the plans.
        why: what was wrong, where nothing could be driven.
    """

    shares: tuple[Share, ...]
    steps: int
    judge: str | None = None
    why: str = ""

    @property
    def recommended(self) -> Share | None:
        """The cheapest guard that does about as well as the best, few drives of which prove little."""
        best: Share | None = None
        for share in self.shares:
            if best is None or share.better_than(best):
                best = share
        return best

    def summary(self) -> dict[str, object]:
        """For JSON documents."""
        best = self.recommended
        return {
            "recommended": None if best is None else best.guard,
            "share": None if best is None else best.share,
            "interval": None if best is None else list(best.interval),
            "guards": [share.summary() for share in self.shares],
            "seed": SEED,
            "steps": self.steps,
            "judge": self.judge,
            "why": self.why,
        }


def _superiority(first: Share, second: Share, by: float) -> float:
    """Chance that the first share is the larger one by so much, of uniform priors (a beta posterior each)."""
    grid = np.linspace(0.0, 1.0, 2001)
    mass = []
    for share in (first, second):
        density = grid**share.satisfied * (1.0 - grid) ** (share.drives - share.satisfied)
        mass.append(density / density.sum())
    below = np.interp(grid + by, grid, np.cumsum(mass[0]))
    return float(((1.0 - below) * mass[1]).sum())


class _LateError(Exception):
    """The time is over in the middle of a drive."""


@dataclass(slots=True)
class _Known:
    """The drives under one guard: start, as (seed, agent) -> satisfied, and safe.

    `cost`: seconds a seed; 0 before the first. `agents`: of a seed. `given_up`: a seed takes too long.
    """

    agents: int
    found: dict[tuple[int, int], tuple[bool, bool | None]] = field(default_factory=dict)
    seeds: int = 0
    cost: float = 0.0
    given_up: bool = False

    @property
    def share(self) -> float:
        return sum(good for good, _ in self.found.values()) / max(1, len(self.found))

    @property
    def interval(self) -> tuple[float, float]:
        return wilson(self.share, len(self.found)) if self.found else (0.0, 1.0)


def closed_loop(run: Run, left: Callable[[], float], most: int = DRIVES, seed: int = SEED) -> ClosedLoop:
    """Drive a policy in the world of its system, without and with guards, while there is time.

    Args:
        run: with its policy.
        left: seconds that are left; nothing is begun, and nothing gone on with, once that is 0.
        most: drives under one guard.
        seed: of the first drives; the others follow.

    Returns:
        What was driven to its end. A world that fails, or rules that do not fit, are told as `why`.
    """
    test = run.task.system.decl.test
    try:
        rules = rules_of(run)
        trial = _Trial(run, rules, left, most, seed)
        trial.drive()
    except StlcError as error:
        return ClosedLoop((), test.steps, why=error.diagnostics[0].message)
    return ClosedLoop(trial.shares(), test.steps, None if rules is None else rules.name)


def fresh_share(run: Run, guard: Mode, drives: int, seed: int = 0) -> Share:
    """At least so many drives under one guard, however long they take, from the seeds that `simulate` takes.

    Raises:
        SystemFileError: the world fails. SpecError: the rules do not fit.
    """
    trial = _Trial(run, rules_of(run), lambda: 1e9, drives, seed)
    agents = trial.test.agents
    seeds = tuple(range(seed, seed + -(-drives // agents)))
    good, safe = trial._judged(trial._driven(guard, seeds, agents, share=1.0))
    return Share(guard, len(good), int(good.sum()), None if safe is None else int(safe.sum()))


class _Trial:
    """Drives under all guards."""

    def __init__(
        self, run: Run, rules: Rules | None, left: Callable[[], float], most: int, seed: int
    ) -> None:
        self.task, self.policy, self.rules, self.left = run.task, run.policy, rules, left
        self.most, self.seed = most, seed
        self.make = world_type(self.task.system.decl)
        self.test = self.task.system.decl.test
        self.known: Mapping[Mode, _Known] = {mode: _Known(self.test.agents) for mode in GUARDS}

    def drive(self) -> None:
        """Drive seeds, until every share is known well or the time is over."""
        while (mode := self._next()) is not None:
            self._more(mode)

    def _next(self) -> Mode | None:
        """The guard that needs drives the most: the one of the widest interval among those that matter."""
        if self.left() <= 0.0:
            return None
        for mode in GUARDS:
            known = self.known[mode]
            if known.seeds and known.share == 1.0:
                break
            if not known.seeds and not known.given_up:
                return mode
        driven = {mode: known for mode, known in self.known.items() if known.seeds and not known.given_up}
        best = max((known.share for known in driven.values()), default=0.0)
        wide = {
            mode: known.interval[1] - known.interval[0]
            for mode, known in driven.items()
            if known.interval[1] >= best and len(known.found) < self.most
        }
        if not wide:
            return None
        mode = max(wide, key=wide.__getitem__)
        return None if wide[mode] <= 2.0 * NARROW else mode

    def _more(self, mode: Mode) -> None:
        """Drive a seed under a guard, or as many more as there were, if there is time for them."""
        known = self.known[mode]
        count = 1
        if known.seeds:
            time_for = int(0.6 * self.left() / known.cost) if known.cost else 1
            room = -(-(self.most - len(known.found)) // known.agents)
            count = min(max(1, known.seeds), room, time_for)
            if count < 1:
                known.given_up = True
                return
        seeds = tuple(range(self.seed + known.seeds, self.seed + known.seeds + count))
        whole = self.left()
        try:
            recording = self._driven(mode, seeds, known.agents, share=1.0 if known.seeds else 0.5)
        except _LateError:
            known.given_up = bool(known.seeds) or known.agents == 1 or self.left() <= 0.0
            known.agents = max(1, known.agents // FEWER)
            return
        good, safe = self._judged(recording)
        for row in range(len(good)):
            where, agent = divmod(row, known.agents)
            known.found[seeds[where], agent] = bool(good[row]), None if safe is None else bool(safe[row])
        known.cost = (whole - self.left()) / count
        known.seeds += count

    def _driven(self, mode: Mode, seeds: Sequence[int], agents: int, share: float) -> DeploymentRecording:
        """Drives to their end. Raises _LateError where that would take more than a share of what is left."""
        setting = Setting(tuple(seeds), agents, self.test.steps, self.test.replan)
        guard = Guard(self.task, self.policy, mode, limits=Limits(seconds=setting.limit))
        begun, recorder = self.left(), Recorder(agents, pictured=False)

        def watch(moment: SimulationStep) -> None:
            spent = begun - self.left()
            hopeless = moment.step >= 3 and spent * moment.steps / moment.step > 1.5 * max(begun, 0.0)
            if self.left() <= 0.0 or spent > share * begun or hopeless:
                raise _LateError

        drive(guard, self.make, setting, recorder, watch)
        recording = recorder.recording()
        assert recording is not None
        return recording

    def _judged(self, recording: DeploymentRecording) -> tuple[NDArray[np.bool_], NDArray[np.bool_] | None]:
        """Drives that satisfy the mission, and those that satisfy its requirements tagged `@safety`."""
        rows = len(recording.states)
        if self.rules is None:
            executed = judge_executed(self.task, recording, savable=np.ones(rows, dtype=bool))
            drives = drives_of_plans(executed.rules, executed.savable, self.task.dt)
            return drives.obeyed, executed.agents(executed.safety) if executed.safety else None
        verdict = verdict_on_drives(self.rules, self.task, recording)
        found = {judgement.name: np.array(judgement.statuses) for judgement in verdict}
        names = [rule.name for rule in verdict.subject.compiled.safety]
        safe = obeying({name: found[name] for name in names}, rows) if names else None
        return obeying(found, rows), safe

    def shares(self) -> tuple[Share, ...]:
        """Counts under each guard."""
        free = self.known["none"].found
        shares = []
        for mode, known in self.known.items():
            if not known.found:
                continue
            both = [(good, free[start][0]) for start, (good, _) in known.found.items() if start in free]
            safe = [kept for _, kept in known.found.values()]
            shares.append(
                Share(
                    mode,
                    drives=len(known.found),
                    satisfied=sum(good for good, _ in known.found.values()),
                    safe=None if None in safe else sum(map(bool, safe)),
                    compared=0 if mode == "none" else len(both),
                    gained=sum(good and not alone for good, alone in both) if mode != "none" else 0,
                    lost=sum(alone and not good for good, alone in both),
                )
            )
        return tuple(shares)
