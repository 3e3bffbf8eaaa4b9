"""Closed-loop satisfaction rate of a trained policy in the declared world, without and with guards.

The accuracy of plans says little about closed-loop behaviour: plans are replaced at every step, a guard
intervenes, and the visited states differ from the training distribution. Therefore the policy is simulated
from random seeds that neither training nor `stlc simulate` uses by default, and the runs are judged as `stlc
simulate` judges them.

All guards are simulated from the same initial states. A more expensive guard is simulated only if some runs
fail under the cheaper ones. The remaining time is spent on more runs of the guards that may still be the
best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from stlc.controller.deployment.simulator import (
    DeploymentRecording,
    Recorder,
    Setting,
    SimulationStep,
    simulate,
)
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.evaluation.rules import Rules, judge_runs_by_plans, obeying, rules_of, verdict_on_runs
from stlc.controller.guard.candidates import Limits, Mode
from stlc.controller.guard.guard import Guard
from stlc.controller.training.config import DRIVES
from stlc.controller.world import world_type
from stlc.diagnostics import StlcError
from stlc.registry import GUARDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.controller.training.run import Run

SEED = 1 << 40
"""Seed of the first closed-loop runs; those of `simulate` begin at 0."""
COMPARED: tuple[Mode, ...] = GUARDS[: GUARDS.index("full") + 1]
"""Guards by increasing cost. The guard "certified" needs a scenario, and training has none."""
NARROW = 0.005
"""A guard is simulated no more once the confidence interval of its share has at most this half-width."""
NEAR = 0.02
"""Largest difference in share at which the cheaper of two guards is recommended."""
LEAST = 20
"""A guard with at least this number of runs is compared by its share alone, without a probability test."""
SURE = 0.9
"""Probability of being better at which a guard with fewer than `LEAST` runs is recommended."""
FEWER = 4
"""Factor by which the number of agents is reduced if a seed takes too long."""


@dataclass(frozen=True, slots=True)
class Share:
    """Counts of the closed-loop runs under one guard.

    Attributes:
        guard: name of the guard.
        runs: number of runs; a run is one agent under one seed.
        satisfied: number of runs that satisfy the mission. The mission consists of the rules that the system
            file names (`test: judge`); if it names none, it is the specification.
        safe: number of runs that satisfy the requirements tagged `@safety`; None if there are none.
        compared: number of runs that were also made without a guard from the same initial states.
        gained: number of compared runs that satisfy the mission only with the guard.
        lost: number of compared runs that satisfy the mission only without the guard.
    """

    guard: Mode
    runs: int
    satisfied: int
    safe: int | None
    compared: int = 0
    gained: int = 0
    lost: int = 0

    @property
    def share(self) -> float:
        """Share of the runs that satisfy the mission."""
        return self.satisfied / self.runs

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the share."""
        return wilson(self.share, self.runs)

    def better_than(self, other: Share) -> bool:
        """True if this guard's share of satisfying runs exceeds that of `other` by more than `NEAR`.

        If this guard has fewer than `LEAST` runs, a second condition must hold: with a probability of at
        least `SURE`, its true share exceeds that of `other` by more than `NEAR`.
        """
        better = self.share > other.share + NEAR
        return better and (self.runs >= LEAST or _superiority(self, other, NEAR) >= SURE)

    def summary(self) -> dict[str, object]:
        """The counts and shares under one guard as a JSON object."""
        safe = None if self.safe is None else self.safe / self.runs
        return {
            "guard": self.guard,
            "drives": self.runs,
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
    """Closed-loop results of a trained policy.

    Attributes:
        shares: results of the simulated guards, one entry per guard, the cheapest guard first; empty if no
            run was completed.
        steps: length of a run in steps.
        judge: name of the specification that judges the runs; None if the specification of the plans judges
            them.
        why: message of the error that prevented every run; empty if there was none.
    """

    shares: tuple[Share, ...]
    steps: int
    judge: str | None = None
    why: str = ""

    @property
    def recommended(self) -> Share | None:
        """Counts of the recommended guard: the cheapest one that is nearly as good as the best one.

        Guards are compared by the share of runs that satisfy the mission. A share that is at most `NEAR`
        lower counts as nearly as good. A more expensive guard with few runs is preferred only if it is better
        with high probability (see `Share.better_than`). None if there are no runs.
        """
        best: Share | None = None
        for share in self.shares:
            if best is None or share.better_than(best):
                best = share
        return best

    def summary(self) -> dict[str, object]:
        """The recommended guard and the results of all guards as a JSON object."""
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
    """Probability that the true share of `first` exceeds that of `second` by more than `by`.

    The prior distributions of both shares are uniform.
    """
    grid = np.linspace(0.0, 1.0, 2001)
    good = np.log(np.maximum(grid, np.finfo(np.float64).tiny))
    mass = []
    for share in (first, second):
        failed = share.runs - share.satisfied
        log = share.satisfied * good + failed * good[::-1]  # the density itself underflows with many runs
        density = np.exp(log - log.max())
        mass.append(density / density.sum())
    below = np.interp(grid + by, grid, np.cumsum(mass[0]))
    return float(((1.0 - below) * mass[1]).sum())


class _LateError(Exception):
    """Raised when the time limit is reached during a simulation."""


@dataclass(slots=True)
class _Known:
    """Results of the runs already simulated under one guard.

    Attributes:
        agents: number of agents per seed in further simulations.
        found: verdicts on each run, by (seed, agent): whether the run satisfies the mission, and whether it
            satisfies the safety requirements (None if there are none).
        seeds: number of simulated seeds.
        cost: measured seconds per seed; 0 before the first seed.
        given_up: True if the guard is not simulated any more, because a seed takes too long.
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
    """Simulate a policy in the world of its system, without and with guards, within the time limit.

    Args:
        run: trained run.
        left: function that returns the remaining seconds; simulation stops once they are 0.
        most: maximum number of runs of each guard.
        seed: first seed; further seeds are the integers after it.

    Returns:
        Results of the completed runs. If the world fails, or the rules (specification of closed-loop runs) do
        not fit the system, `shares` is empty, and `why` contains the message.
    """
    test = run.task.system.decl.test
    try:
        rules = rules_of(run)
        trial = _Trial(run, rules, left, most, seed)
        trial.simulate()
    except StlcError as error:
        return ClosedLoop((), test.steps, why=error.diagnostics[0].message)
    return ClosedLoop(trial.shares(), test.steps, None if rules is None else rules.name)


def fresh_share(run: Run, guard: Mode, runs: int, seed: int = 0) -> Share:
    """Simulate at least `runs` runs under one guard, without time limit, from the seeds of `stlc simulate`.

    Raises:
        SystemFileError: a method of the world raises an exception or returns wrong values.
        SpecError: the rules (specification of closed-loop runs) do not fit the system.
    """
    trial = _Trial(run, rules_of(run), lambda: 1e9, runs, seed)
    agents = trial.test.agents
    seeds = tuple(range(seed, seed + -(-runs // agents)))
    good, safe = trial._judged(trial._simulated(guard, seeds, agents, share=1.0))
    return Share(guard, len(good), int(good.sum()), None if safe is None else int(safe.sum()))


class _Trial:
    """Closed-loop simulation of one policy under all guards, in progress."""

    def __init__(
        self, run: Run, rules: Rules | None, left: Callable[[], float], most: int, seed: int
    ) -> None:
        self.task, self.policy, self.rules, self.left = run.task, run.policy, rules, left
        self.most, self.seed = most, seed
        self.make = world_type(self.task.system.decl)
        self.test = self.task.system.decl.test
        self.known: Mapping[Mode, _Known] = {mode: _Known(self.test.agents) for mode in COMPARED}

    def simulate(self) -> None:
        """Simulate seeds until the time is used up, or until it is clear enough which guard is best."""
        while (mode := self._next()) is not None:
            self._more(mode)

    def _next(self) -> Mode | None:
        """Guard to simulate next; None if the time is used up or no further runs are needed.

        At first, guards are simulated once each, from the cheapest one up to the first guard under which all
        runs satisfy the mission. After that, a guard is left out if its confidence interval lies below the
        best share of satisfying runs. Of the other guards, the one with the widest confidence interval is
        returned.
        """
        if self.left() <= 0.0:
            return None
        for mode in COMPARED:
            known = self.known[mode]
            if known.seeds and known.share == 1.0:
                break
            if not known.seeds and not known.given_up:
                return mode
        simulated = {mode: known for mode, known in self.known.items() if known.seeds and not known.given_up}
        best = max((known.share for known in simulated.values()), default=0.0)
        wide = {
            mode: known.interval[1] - known.interval[0]
            for mode, known in simulated.items()
            if known.interval[1] >= best and len(known.found) < self.most
        }
        if not wide:
            return None
        mode = max(wide, key=wide.__getitem__)
        return None if wide[mode] <= 2.0 * NARROW else mode

    def _more(self, mode: Mode) -> None:
        """Simulate further seeds under the guard `mode` and store their results.

        The first call simulates one seed. Each later call simulates as many seeds as all calls before, or
        fewer if the remaining time does not suffice. If the first seed takes too long, the number of agents
        is reduced.
        """
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
            recording = self._simulated(mode, seeds, known.agents, share=1.0 if known.seeds else 0.5)
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

    def _simulated(self, mode: Mode, seeds: Sequence[int], agents: int, share: float) -> DeploymentRecording:
        """Simulate `seeds` with `agents` agents each under the guard `mode` and return the recording.

        Raises:
            _LateError: the simulation has used the fraction `share` of the remaining time, or will clearly
                take longer than the remaining time.
        """
        setting = Setting(tuple(seeds), agents, self.test.steps, self.test.replan)
        guard = Guard(self.task, self.policy, mode, limits=Limits(seconds=setting.limit))
        whole, recorder = self.left(), Recorder(agents, pictured=False)

        def watch(moment: SimulationStep) -> None:
            spent = whole - self.left()
            hopeless = moment.step >= 3 and spent * moment.steps / moment.step > 1.5 * max(whole, 0.0)
            if self.left() <= 0.0 or spent > share * whole or hopeless:
                raise _LateError

        simulate(guard, self.make, setting, recorder, watch)
        recording = recorder.recording()
        assert recording is not None
        return recording

    def _judged(self, recording: DeploymentRecording) -> tuple[NDArray[np.bool_], NDArray[np.bool_] | None]:
        """Return two masks of runs, (rows,) each: those that satisfy the mission, and those that are safe.

        A run is safe if it satisfies the requirements of the mission that are tagged `@safety`. If there are
        none, the second mask is None.
        """
        rows = len(recording.states)
        if self.rules is None:
            executed = judge_executed(self.task, recording, viable=np.ones(rows, dtype=bool))
            runs = judge_runs_by_plans(executed, self.task.system.dt)
            return runs.obeyed, executed.agents(executed.safety) if executed.safety else None
        verdict = verdict_on_runs(self.rules, self.task, recording)
        found = {judgement.name: np.array(judgement.statuses) for judgement in verdict}
        names = [rule.name for rule in verdict.subject.compiled.safety]
        safe = obeying({name: found[name] for name in names}, rows) if names else None
        return obeying(found, rows), safe

    def shares(self) -> tuple[Share, ...]:
        """Counts of the runs under each simulated guard, the cheapest guard first."""
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
                    runs=len(known.found),
                    satisfied=sum(good for good, _ in known.found.values()),
                    safe=None if None in safe else sum(map(bool, safe)),
                    compared=0 if mode == "none" else len(both),
                    gained=sum(good and not alone for good, alone in both) if mode != "none" else 0,
                    lost=sum(alone and not good for good, alone in both),
                )
            )
        return tuple(shares)
