"""Evaluation after training: held-out states, conflict diagnosis, closed-loop simulations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from stlc.controller.evaluation.closed_loop import ClosedLoop, closed_loop
from stlc.controller.evaluation.held_out import Score, score, silent
from stlc.controller.run.run import Run
from stlc.controller.search.conflict import conflict, refuted
from stlc.controller.training.budget import TimeBudget, simulation_reserve, verdict_reserve
from stlc.jsontext import plain

if TYPE_CHECKING:
    from collections.abc import Callable

    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.controller.run.config import ResolvedConfig
    from stlc.controller.training.writer import RunWriter
    from stlc.diagnostics import Diagnostic

VERDICT_OVER = 0.04
"""Share of a budget by which the evaluation may exceed it before the feasibility search is stopped."""
SIMULATION_SHARE = 0.15
"""Time for closed-loop simulations after training without budget, as a share of the training time."""
FIRST_DRIVES, FIRST_SHARE = 20.0, 1.0 / 3.0
"""Time for the first closed-loop simulations, which guards are compared by: seconds, and share of the budget.

Both are upper limits. The time beyond that of the other simulations is not part of the budget.
"""
VERDICT_LEAST, VERDICT_SHARE = 20.0, 0.2
"""Time for the evaluation of a run without budget: seconds, and share of the duration of its steps."""


@dataclass(frozen=True, slots=True)
class TrainingOutcome:
    """Result of a training run.

    Attributes:
        run: the run with its policy.
        score: result on held-out states; None if training was interrupted. Of several ranks (processes) only
            the first has a score.
        seconds: duration of the training, evaluation on held-out states included.
        interrupted: whether the user ended the training before its last step.
        ranks: number of processes that trained together.
        why: if no plan was found from any initial state, the diagnosis of the conflicting requirements; else
            None.
        steps: number of training steps made.
        simulated: closed-loop results; None if there was no simulation.
    """

    run: Run
    score: Score | None
    seconds: float
    interrupted: bool
    ranks: int = 1
    why: Diagnostic | None = None
    steps: int = 0
    simulated: ClosedLoop | None = None


@dataclass(slots=True)
class FinalEvaluation:
    """Evaluation of a trained policy, in the part of the budget that remains after training.

    Attributes:
        writer: writer of the run's folder.
        task: problem that the policy was trained for.
        config: resolved options of the run.
        time: time budget of the run.
        report: function that receives the progress as a short text.
        trained: clock reading at the end of the training, when the evaluation begins.
    """

    writer: RunWriter
    task: Task
    config: ResolvedConfig
    time: TimeBudget
    report: Callable[[str], None] = silent
    trained: float = 0.0

    @property
    def reserve(self) -> float:
        """Seconds of the budget reserved for the evaluation on held-out states and the simulations."""
        return verdict_reserve(self.time.seconds) + self._for_simulations

    @property
    def _for_simulations(self) -> float:
        return simulation_reserve(self.time.seconds) if self.config.drives else 0.0

    def of(self, policy: Policy, steps: int) -> TrainingOutcome:
        """Evaluate a trained policy, write the result into the run's folder, and return it.

        `steps`: number of training steps made.

        The status of the run becomes `finished`.
        """
        self.trained = self.time.now()

        def late(factor: float = 1.0) -> bool:
            return self.time.now() - self.trained > factor * self._verdict_seconds

        result = score(self.task, policy, n=self.config.held_out, stop=late, report=self.report)
        self.writer.held_out(self.task, result)
        why = conflict(self.task, lambda: late(2.0)) if result.feasible == 0.0 else None
        run = Run(self.writer.folder, self.task, policy)
        simulated = self._simulated(run) if why is None else None
        found: dict[str, object] = {"seconds": self.time.spent}
        if why is not None:
            found |= {"why": why.message, "proved": refuted(self.task)}
        found |= {} if simulated is None else {"closed_loop": plain(simulated)}
        if self.config.falsify and (rounds := self.writer.folder.record().get("falsification")):
            found["falsification"] = rounds
        self.writer.close("finished", {**result.summary(), **found})
        seconds, ranks = self.time.spent, self.config.ranks
        return TrainingOutcome(run, result, seconds, False, ranks, why=why, steps=steps, simulated=simulated)

    def _simulated(self, run: Run) -> ClosedLoop | None:
        """Simulate the policy in closed loop, within the remaining time; None if `config.drives` is 0."""
        if not self.config.drives:
            return None
        self.report("evaluation, closed-loop runs")
        time, started = self.time, self.time.now()
        whole = time.seconds if time.allowed else started - time.started
        if time.allowed:
            end = time.started + (1.0 + VERDICT_OVER) * whole
            end = max(end, started + 0.5 * simulation_reserve(whole))
        else:
            end = started + SIMULATION_SHARE * whole
        last = max(end, started + min(FIRST_DRIVES, FIRST_SHARE * whole))
        return closed_loop(run, lambda: last - time.now(), self.config.drives, extra=last - end)

    @property
    def _verdict_seconds(self) -> float:
        """Seconds left for the evaluation on held-out states.

        Without a budget, this is a share of the training time.
        """
        spent = self.trained - self.time.started
        if not self.time.allowed:
            return max(VERDICT_LEAST, VERDICT_SHARE * spent)
        left = (1.0 + VERDICT_OVER) * self.time.seconds - self._for_simulations - spent
        return max(left, 0.5 * verdict_reserve(self.time.seconds))
