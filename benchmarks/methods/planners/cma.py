"""`cma`: covariance matrix adaptation over plans (Hansen 2016), by a package of the extra `bench`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from stlc.controller.options import bounded
from stlc.extras import needed

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver


@dataclass(frozen=True, slots=True)
class Cma:
    """CMA-ES in which every restart doubles the population (IPOP); controls are scaled to [-1, 1].

    Attributes:
        sigma: initial standard deviation, in half-widths of the control ranges.
        population: number of samples per generation; 0 for the default of the package `cma`, 4 + 3 ln(d),
            where d is the number of entries of a plan.
        diagonal: whether the covariance is diagonal, which is faster for long plans.
    """

    sigma: float = bounded(0.5, 1e-9, 1e6)
    population: int = bounded(0, 0, 10**6)
    diagonal: bool = False

    def prepare(self, task: Task) -> Solver:  # noqa: ARG002 - the same for all tasks
        """Return a function that searches for plans by CMA-ES.

        Raises:
            MissingError: R301, the package `cma` is not installed.
        """
        cma = needed("cma", "planner `cma` needs")
        return partial(self._run, strategy=cma.CMAEvolutionStrategy)

    def _run(self, search: PlanSearch, strategy: Any) -> None:
        for row in range(len(search.states)):
            restarts = 0
            while row in search.open():
                self._search(search, row, strategy, restarts)
                restarts += 1

    def _search(self, search: PlanSearch, row: int, strategy: Any, restarts: int) -> None:
        """Run CMA-ES once for the initial state with index `row`.

        The run ends once it has converged, reached the target robustness, or spent the budget. The first run
        begins at the initial guess, later runs begin at random plans.

        Args:
            search: the search for plans, which keeps the best plan.
            row: index of the initial state.
            strategy: class of the package `cma` that runs CMA-ES.
            restarts: number of earlier runs for this state; each of them has doubled the population.
        """
        system, rows = search.task.system, torch.tensor([row])
        low, high = system.control_low.double(), system.control_high.double()
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        options = {"bounds": [-1.0, 1.0], "verbose": -9, "CMA_diagonal": self.diagonal}
        options["seed"] = 1 + int(torch.randint(2**31 - 1, (), generator=search.generator))
        dims = search.start[row].numel()
        options["popsize"] = (self.population or 4 + int(3 * np.log(dims))) * 2**restarts
        more = max(0, 2 - dims)  # the package has no search over a single number
        with search.charged(rows):
            guess = ((search.start[row] - middle) / half).clamp(-1.0, 1.0).flatten().numpy()
            if restarts:
                guess = torch.rand(dims, generator=search.generator).double().mul(2).sub(1).numpy()
            es = strategy(np.pad(guess, (0, more)), self.sigma, options)
        while not es.stop() and row in search.open():
            with search.charged(rows):
                asked = es.ask()
                entries = torch.as_tensor(np.array(asked))[:, :dims]
                plans = middle + half * entries.view(1, len(asked), -1, len(half))
                rho = search.offer(rows, plans)[0]
                cost = torch.nan_to_num(-rho, nan=torch.inf, posinf=1e9, neginf=-1e9)
                es.tell(asked, cost.tolist())


PLANNER = Cma
