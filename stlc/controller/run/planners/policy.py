"""`policy`: the plans of the trained policy of a run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.controller.run.run import Run
from stlc.diagnostics import usage

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver


@dataclass(frozen=True, slots=True)
class PolicyPlans:
    """Planner that returns the plan selected by a trained policy.

    It makes one evaluation per initial state, whatever the budget.

    Attributes:
        run: the training run, given by its folder, number, name or specification, or `latest`.
        runs: folder of all runs.
    """

    run: str = "latest"
    runs: str = "runs"

    def prepare(self, task: Task) -> Solver:
        """Load the policy and return a function that proposes its plans.

        Raises:
            RunError: R101, the run is damaged; U101, it was trained for another system.
        """
        run = Run.open(self.run, root=Path(self.runs))
        policy, own = run.policy, run.task.system
        same = (own.names, own.control_names, own.horizon)
        if same != (task.system.names, task.system.control_names, task.system.horizon):
            trained = f"{run.task.compiled.name} and {own.decl.name}"
            message = f"run `{run.dir.name}` is a policy for {trained}, not for {task.compiled.name}"
            raise usage(message, "stlc plan SPEC --method policy --option run=RUN", "stlc runs list")
        return partial(self._run, policy=policy.for_task(task))

    def _run(self, search: PlanSearch, policy: Policy) -> None:
        rows = search.open()
        with search.charged(rows):
            search.offer(rows, policy.plan(search.states[rows].float()))
        search.ended[rows] = True


PLANNER = PolicyPlans
