"""Failures of closed-loop drives as training states: rounds of falsification during the training.

At some moments of a training, the present policy drives in the world of its system, and a search chooses the
random numbers of the world so that drives fail. The states at which the policy then planned wrongly are kept,
and mixed into the batches and the search rounds from then on. As in DAgger (Ross, Gordon and Bagnell 2011),
the policy is thus trained on the states that it brings about itself, and on the worst of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from torch import Tensor

from stlc.native import Stop, never

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from stlc.controller.run.run import Run

FAILURES_VERSION = 3
"""Version of the rounds and of the use of their states; results of older versions are recomputed."""
MOMENTS = (0.25, 0.4, 0.55, 0.7, 0.82)
"""Shares of the planned steps after which a round is due."""
SHARE = 0.2
"""Share of the time since the start that rounds may take; a round ends with the first batch beyond it."""
WORK = 0.06
"""Decisions of the drives of a round, per training state of the steps since the round before it."""
LEAST_WORK, MOST_WORK = 500, 100_000
"""Bounds of the number of decisions of a round."""
KEPT = 8192
"""States kept at most; the oldest are dropped."""
POINTS = 8
"""Points of the least robust drives that the next round simulates first."""
MIXED = 0.125
"""Part of the fresh states of a step that kept states replace."""


@dataclass(frozen=True, slots=True)
class SearchRound:
    """Result of a round of falsification.

    Attributes:
        states: states at which the policy planned wrongly in drives, (k, n) float64.
        points: points of all simulations, the least robust first, (simulations, dim).
        drives: number of drives with a verdict.
        failing: number of drives that violated a requirement.
    """

    states: Tensor
    points: NDArray[np.float64]
    drives: int
    failing: int


FailureSearch: TypeAlias = "Callable[[Run, int, int, NDArray[np.float64], Stop, Stop], SearchRound | None]"
"""Search for failing drives of a policy; `stlc.assurance` supplies it, which is above the training.

It receives the run with the present policy; the greatest number of simulations; the seed of the search;
points of earlier rounds, which are simulated first, (p, dim); a function that is called after each batch, and
another at every step: no other batch follows once the former returns True, and the search ends at once, with
None, once the latter does. The size of a batch does not depend on the number of simulations, so that a search
that ended early is repeated by one of as many simulations.
"""


@dataclass(frozen=True, slots=True)
class FalsificationRounds:
    """Counts of the rounds of a training.

    Attributes:
        rounds: number of rounds.
        drives: number of drives with a verdict.
        failing: number of drives that violated a requirement.
        last_share: share of the drives of the last round that did.
        states: number of kept states.
    """

    rounds: int
    drives: int
    failing: int
    last_share: float
    states: int


@dataclass(slots=True)
class FailureStates:
    """States of failing drives, and the progress of the rounds that supply them.

    Attributes:
        states: kept states, the newest last, (k, n).
        points: points of the least robust simulations of the last round, (p, dim).
        moment: number of moments at which a round was due, with or without time for one.
        rounds: number of rounds made.
        last: step of the last round.
        drives: number of drives of all rounds.
        failing: number of drives that violated a requirement, of all rounds.
        latest: share of the drives of the last round that violated a requirement.
        repairing: number of kept states from which the present search for plans starts.
    """

    states: Tensor
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    moment: int = 0
    rounds: int = 0
    last: int = 0
    drives: int = 0
    failing: int = 0
    latest: float = 0.0
    repairing: int = 0

    def due(self, step: int, steps: int) -> bool:
        """True if a round is due after `step` of `steps` steps."""
        return self.moment < len(MOMENTS) and step >= MOMENTS[self.moment] * steps

    def simulations(self, run: Run, step: int, states: int) -> int:
        """Number of simulations of a round after `step` steps, of `states` training states each.

        A time limit may end the round earlier.
        """
        test = run.task.system.decl.test
        decisions = min(max(WORK * (step - self.last) * states, LEAST_WORK), MOST_WORK)
        return max(round(decisions * test.replan / (test.agents * test.steps)), 2)

    def search(
        self, search: FailureSearch, run: Run, step: int, simulations: int, generator: torch.Generator,
        over: Stop = never, stop: Stop = never,
    ) -> int | None:  # fmt: skip
        """Make a round and return its number of simulations; None, without any effect, if `stop` ended it.

        Args:
            search: search for failing drives.
            run: run with the present policy.
            step: number of completed steps.
            simulations: number of simulations at most; 0: the moment passes without a round.
            generator: source of the seed of the round.
            over: function that is called after each batch of simulations; the round ends once it returns
                True.
            stop: function that is called repeatedly; the round is given up once it returns True.
        """
        if not simulations:
            self.moment += 1
            return 0
        before = generator.get_state()
        seed = int(torch.randint(2**31, (), generator=generator))
        found = search(run, simulations, seed, self.points, over, stop)
        if found is None:
            generator.set_state(before)
            return None
        fresh = found.states.to(self.states)
        self.states = torch.cat((self.states, fresh))[-KEPT:]
        self.points = found.points[:POINTS]
        self.moment, self.rounds, self.last = self.moment + 1, self.rounds + 1, step
        self.drives, self.failing = self.drives + found.drives, self.failing + found.failing
        self.latest = found.failing / max(found.drives, 1)
        return len(found.points)

    def mixed(self, fresh: Tensor, generator: torch.Generator) -> Tensor:
        """The states `fresh`, (batch, n), of which kept states replace the last ones."""
        count = self.count(len(fresh))
        if not count:
            return fresh
        chosen = torch.randint(len(self.states), (count,), generator=generator).to(fresh.device)
        return torch.cat((fresh[: len(fresh) - count], self.states[chosen]))

    def count(self, batch: int) -> int:
        """Number of kept states among `batch` states of a step."""
        return int(MIXED * batch) if len(self.states) else 0

    def drawn(self, count: int, generator: torch.Generator) -> Tensor:
        """At most `count` different kept states in random order, (k, n)."""
        order = torch.randperm(len(self.states), generator=generator)[:count]
        return self.states[order.to(self.states.device)]

    def summary(self) -> FalsificationRounds:
        """Counts for the record of the run."""
        return FalsificationRounds(self.rounds, self.drives, self.failing, self.latest, len(self.states))

    # ------------------------------------------------------------- checkpoints

    def tensors(self) -> dict[str, Tensor]:
        """Tensors from which the rounds continue exactly."""
        counts = (self.moment, self.rounds, self.last, self.drives, self.failing, self.repairing)
        return {
            "states": self.states,
            "points": torch.from_numpy(self.points.copy()),
            "counts": torch.tensor(counts, dtype=torch.int64),
            "latest": torch.tensor(self.latest, dtype=torch.float64),
        }

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the state from `tensors`, which the method of this name returned."""
        self.states = tensors["states"].to(self.states.device)
        self.points = tensors["points"].numpy()
        counts = tensors["counts"].tolist()
        self.moment, self.rounds, self.last, self.drives, self.failing, self.repairing = counts
        self.latest = float(tensors["latest"])
