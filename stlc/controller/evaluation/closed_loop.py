"""Closed-loop satisfaction rate of a trained policy in the declared world, without and with guards.

The accuracy of plans says little about closed-loop behaviour: plans are replaced at every step, a guard
intervenes, and the visited states differ from the training distribution. Therefore the policy is simulated
from random seeds that neither training nor `stlc simulate` uses by default, and the runs are judged as `stlc
simulate` judges them.

All guards are simulated, counted and compared from the same initial states. A more expensive guard is
simulated only if some runs fail under the cheaper ones. The remaining time is spent on more initial states.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np

from stlc.compile.deadlines import unreached
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import (
    DeploymentRecording,
    Recorder,
    SimulationStep,
    simulate,
)
from stlc.controller.evaluation.causes import Cause, losses
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.evaluation.rules import Rules, judge_runs_by_plans, runs_by_rules
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kind import compared_guards
from stlc.controller.run.config import DRIVES
from stlc.controller.run.run import Run
from stlc.controller.world import world_type
from stlc.diagnostics import StlcError
from stlc.jsontext import Num
from stlc.registry import GUARDS

SEED = 1 << 40
"""Seed of the first closed-loop runs; those of `simulate` begin at 0."""
COMPARED = compared_guards()
"""Guards by increasing cost. One that needs a scenario is none of them: training has none."""
NARROW = 0.005
"""A guard is simulated no more once the confidence interval of its share has at most this half-width."""
NEAR = 0.02
"""Largest difference in share at which the cheaper of two guards is recommended."""
LEAST = 20
"""Minimum number of common initial states from which guards are compared, and one is recommended."""
EXPLAINED = 12
"""Number of failed runs under each guard whose cause is determined."""
FEWER = 4
"""Factor by which the number of agents is reduced if a seed takes too long."""


@dataclass(frozen=True, slots=True)
class Driven:
    """Verdict on one run.

    Attributes:
        obeyed: whether it satisfies the mission.
        safe: whether it satisfies the requirements tagged `@safety`; None if there are none.
        broken: requirement that it violates -> time of the violation in seconds; None if not determined.
        cause: why it fails; None if it does not, or if this was not determined.
    """

    obeyed: bool
    safe: bool | None = None
    broken: Mapping[str, float | None] = field(default_factory=dict)
    cause: Cause | None = None


@dataclass(frozen=True, slots=True)
class Violated:
    """Requirement that runs violate.

    Attributes:
        requirement: its name.
        drives: number of runs that violate it.
        seconds: median time of the violations; None if no time was determined.
        due: mission time at which it is due, in seconds, if plans from the start end before; else None.
    """

    requirement: str
    drives: int
    seconds: float | None
    due: float | None = None


@dataclass(frozen=True, slots=True)
class Share:
    """Counts of the closed-loop runs under one guard.

    Attributes:
        guard: name of the guard.
        runs: number of runs; a run is one agent under one seed.
        satisfied: number of runs that satisfy the mission. The mission consists of the rules that the system
            file names (`test: judge`); if it names none, it is the specification.
        safe: number of runs that satisfy the requirements tagged `@safety`; None if there are none.
        gained: number of runs that satisfy the mission, and without a guard do not.
        lost: number of runs that violate the mission, and without a guard do not.
        broken: the requirements that runs violate, the one that most runs violate first.
        causes: cause -> number of failed runs that have it, of those whose cause was determined.
    """

    JSON: ClassVar = (
        "guard drives=runs satisfied share interval safe=safe_share compared gained lost broken causes"
    )

    guard: Annotated[str, compared_guards]
    runs: int
    satisfied: int
    safe: int | None
    gained: int = 0
    lost: int = 0
    broken: tuple[Violated, ...] = ()
    causes: Mapping[Cause, int] = field(default_factory=dict)

    @property
    def share(self) -> Num:
        """Share of the runs that satisfy the mission."""
        return self.satisfied / self.runs

    @property
    def interval(self) -> tuple[Num, Num]:
        """95 % Wilson interval of the share."""
        return wilson(self.share, self.runs)

    @property
    def safe_share(self) -> Num | None:
        """Share of the runs that satisfy the requirements tagged `@safety`; None if there are none."""
        return None if self.safe is None else self.safe / self.runs

    @property
    def compared(self) -> int:
        """Number of runs that were compared with runs without a guard."""
        return self.runs if GUARDS.get(self.guard).intervenes else 0


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """Closed-loop results of a trained policy.

    Attributes:
        shares: results of the compared guards from the same initial states, one entry per guard, the cheapest
            guard first; empty if no run was completed.
        steps: length of a run in steps.
        seconds: the same in seconds.
        plan_seconds: length of a plan in seconds.
        judge: name of the specification that judges the runs; None if the specification of the plans judges
            them.
        why: message of the error that prevented every run; empty if there was none.
        left_out: guards that might be better, and made fewer than `LEAST` runs from the initial states of the
            others in the time.
        seed: first seed of the runs.
    """

    JSON: ClassVar = (
        "recommended=guard share interval guards=shares left_out seed steps seconds plan_seconds judge why"
    )

    shares: tuple[Share, ...]
    steps: int
    seconds: Num = 0.0
    plan_seconds: Num = 0.0
    judge: str | None = None
    why: str = ""
    left_out: tuple[Annotated[str, compared_guards], ...] = ()
    seed: int = SEED

    @property
    def recommended(self) -> Share | None:
        """Counts of the recommended guard: the cheapest one that is nearly as good as the best one.

        Guards are compared by the share of runs that satisfy the mission. A share that is at most `NEAR`
        lower counts as nearly as good. None if there are fewer than `LEAST` runs, or if the cheapest guard
        was compared with none of those that might be better.
        """
        alone = len(self.shares) == 1 and bool(self.left_out)
        if not self.shares or self.shares[0].runs < LEAST or alone:
            return None
        best = max(share.share for share in self.shares)
        return next(share for share in self.shares if share.share >= best - NEAR)

    @property
    def guard(self) -> Annotated[str | None, lambda: (*compared_guards(), None)]:
        """Name of the recommended guard; None if there is none."""
        return None if self.recommended is None else self.recommended.guard

    @property
    def share(self) -> Num | None:
        """Share of the runs under the recommended guard that satisfy the mission."""
        return None if self.recommended is None else self.recommended.share

    @property
    def interval(self) -> tuple[Num, Num] | None:
        """95 % Wilson interval of this share."""
        return None if self.recommended is None else self.recommended.interval


class _LateError(Exception):
    """Raised when the time limit is reached during a simulation."""


@dataclass(slots=True)
class _Known:
    """Results of the runs already simulated under one guard.

    Attributes:
        agents: number of agents per seed in further simulations.
        found: verdicts on the runs, by (seed, agent).
        seeds: number of simulated seeds.
        cost: measured seconds per seed; 0 before the first seed.
        given_up: True if the guard is not simulated any more, because a seed takes too long.
    """

    agents: int
    found: dict[tuple[int, int], Driven] = field(default_factory=dict)
    seeds: int = 0
    cost: float = 0.0
    given_up: bool = False

    @property
    def share(self) -> Num:
        return sum(drive.obeyed for drive in self.found.values()) / max(1, len(self.found))

    @property
    def interval(self) -> tuple[float, float]:
        return wilson(self.share, len(self.found)) if self.found else (0.0, 1.0)


def closed_loop(run: Run, left: Callable[[], float], most: int = DRIVES, *, extra: float = 0.0) -> ClosedLoop:
    """Simulate a policy in the world of its system, without and with guards, within the time limit.

    Args:
        run: trained run.
        left: function that returns the remaining seconds; simulation stops once they are 0.
        most: maximum number of runs of each guard.
        extra: seconds among the remaining ones that are only for the first `LEAST` runs of each guard.

    Returns:
        Results of the completed runs. If the world fails, or the rules (specification of closed-loop runs) do
        not fit the system, `shares` is empty, and `why` contains the message.
    """
    system = run.task.system
    steps, dt = system.decl.test.steps, system.dt
    nothing = ClosedLoop((), steps, steps * dt, system.horizon * dt)
    try:
        rules = Rules.of(run)
        trial = _Trial(run, rules, left, most, SEED, extra)
        trial.simulate()
    except StlcError as error:
        return replace(nothing, why=error.diagnostics[0].message)
    judge, shares = None if rules is None else rules.name, trial.shares()
    return replace(nothing, shares=shares, judge=judge, left_out=trial.left_out(shares))


class _Trial:
    """Closed-loop simulation of one policy under all guards, in progress."""

    def __init__(
        self,
        run: Run,
        rules: Rules | None,
        left: Callable[[], float],
        most: int,
        seed: int,
        extra: float = 0.0,
    ) -> None:
        self.task, self.policy, self.rules, self.left = run.task, run.policy, rules, left
        self.most, self.seed, self.extra = most, seed, extra
        self.make = world_type(self.task.system.decl)
        self.test = self.task.system.decl.test
        self.known: Mapping[str, _Known] = {mode: _Known(self.test.agents) for mode in COMPARED}

    def simulate(self) -> None:
        """Simulate seeds until the time is used up, or until it is clear enough which guard is best."""
        while self.left() > 0.0 and (further := self._next()) is not None:
            self._more(*further)

    def _next(self) -> tuple[str, int] | None:
        """Guard to simulate next and number of seeds; None if no further runs are needed or possible.

        At first, guards are simulated once each, from the cheapest one up to the first guard under which all
        runs satisfy the mission. Then a guard that has fewer seeds than others catches up. If all have the
        same seeds, their number is doubled, unless the confidence interval of every guard that may be the
        best is narrow.
        """
        for mode in COMPARED:
            known = self.known[mode]
            if known.seeds and known.share == 1.0:
                break
            if not known.seeds and not known.given_up:
                return mode, 1
        simulated = {mode: known for mode, known in self.known.items() if known.seeds and not known.given_up}
        if not simulated:
            return None
        most = max(known.seeds for known in simulated.values())
        for mode, known in simulated.items():
            if known.seeds < most:
                count = min(most - known.seeds, known.seeds, self._seeds_in_time([known], self.left()))
                known.given_up = count < 1
                return None if known.given_up else (mode, count)
        best = max(known.share for known in simulated.values())
        wide = any(
            known.interval[1] - known.interval[0] > 2.0 * NARROW
            for known in simulated.values()
            if known.interval[1] >= best
        )
        first, known = next(iter(simulated.items()))
        enough = len(known.found) >= LEAST
        wanted = self.most if enough else min(LEAST, self.most)
        room = -(-(wanted - len(known.found)) // known.agents)
        left = self.left() - self.extra * enough
        count = min(most, room, self._seeds_in_time([*simulated.values()], left))
        return (first, count) if wide and count >= 1 else None

    def _seeds_in_time(self, guards: Sequence[_Known], left: float) -> int:
        """Number of further seeds under each of `guards` for which `left` seconds suffice."""
        cost = sum(known.cost for known in guards)
        return int(0.6 * left / cost) if cost else 1

    def _more(self, mode: str, count: int) -> None:
        """Simulate `count` further seeds under the guard `mode` and store their results.

        If the first seed takes too long, the number of agents is reduced, also that of further seeds under
        the other guards.
        """
        known = self.known[mode]
        seeds = tuple(range(self.seed + known.seeds, self.seed + known.seeds + count))
        used = [each.agents for each in self.known.values() if each.seeds]
        agents = min(used) if known.seeds else known.agents
        whole = self.left()
        try:
            recording = self._simulated(mode, seeds, agents, share=1.0 if known.seeds else 0.5)
        except _LateError:
            known.given_up = bool(known.seeds) or known.agents == 1 or self.left() <= 0.0
            known.agents = max(1, known.agents // FEWER)
            return
        if self.rules is not None:
            runs = runs_by_rules(self.rules, self.task, recording)
        else:
            viable = np.ones(len(recording.states), dtype=bool)
            executed = judge_executed(self.task, recording, viable=viable)
            runs = judge_runs_by_plans(executed, self.task.system.dt)
        known.cost = (whole - self.left()) / count
        safe, broken = runs.safe, {each.row: each for each in runs.broken}
        told = [each for each in runs.broken if any(time is not None for time in each.rules.values())]
        room = max(0, EXPLAINED - sum(drive.cause is not None for drive in known.found.values()))
        why = losses(self.task, recording, told[:room], runs.safety, lambda: self.left() <= 0.0)
        for row, obeyed in enumerate(runs.obeyed.tolist()):
            where, agent = divmod(row, agents)
            known.found[seeds[where], agent] = Driven(
                obeyed,
                None if safe is None else bool(safe[row]),
                broken[row].rules if row in broken else {},
                None if (lost := why.get(row)) is None else "told" if lost.inconsistent else lost.why,
            )
        known.seeds += count

    def _simulated(self, mode: str, seeds: Sequence[int], agents: int, share: float) -> DeploymentRecording:
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

    def shares(self) -> tuple[Share, ...]:
        """Counts of the runs under each compared guard, from their common initial states, cheapest first.

        A guard with fewer than `LEAST` runs from the initial states of the cheaper ones is left out.
        """
        compared: dict[str, _Known] = {}
        starts: set[tuple[int, int]] = set()
        for mode, known in self.known.items():
            common = starts & known.found.keys() if compared else set(known.found)
            if common and (not compared or len(common) >= LEAST):
                compared[mode], starts = known, common
        free = compared[GUARDS.default].found if GUARDS.default in compared else {}
        shares = []
        for mode, known in compared.items():
            drives = [known.found[start] for start in starts]
            pairs = [
                (known.found[start].obeyed, free.get(start, known.found[start]).obeyed) for start in starts
            ]
            safe = [drive.safe for drive in drives]
            shares.append(
                Share(
                    mode,
                    runs=len(starts),
                    satisfied=sum(good for good, _ in pairs),
                    safe=None if None in safe else sum(map(bool, safe)),
                    gained=sum(good and not alone for good, alone in pairs),
                    lost=sum(alone and not good for good, alone in pairs),
                    broken=self._violated(drives),
                    causes=Counter(drive.cause for drive in drives if drive.cause is not None),
                )
            )
        return tuple(shares)

    def _violated(self, drives: Sequence[Driven]) -> tuple[Violated, ...]:
        """The requirements that `drives` violate, the one that most of them violate first."""
        counts = Counter(name for drive in drives for name in drive.broken)
        due = {each.requirement: each.seconds for each in unreached(self.task.compiled)}
        found = []
        for name, count in counts.most_common():
            times = [drive.broken[name] for drive in drives if name in drive.broken]
            known = [time for time in times if time is not None]
            found.append(Violated(name, count, float(np.median(known)) if known else None, due.get(name)))
        return tuple(found)

    def left_out(self, shares: Sequence[Share]) -> tuple[str, ...]:
        """Guards that are not among `shares` although they are cheaper than a guard without a failure."""
        perfect = next((share.guard for share in shares if share.share == 1.0), None)
        wanted = COMPARED if perfect is None else COMPARED[: COMPARED.index(perfect)]
        return tuple(mode for mode in wanted if mode not in {share.guard for share in shares})
