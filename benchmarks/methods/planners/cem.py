"""`cem`: the cross-entropy method over plans, or over the parameters of a small policy (Rubinstein 1999).

The settings of Meng and Fan (2023): `population=10000, elites=100, deviation=1, physical=true, rounds=500`
over plans, and `over=policy` for navigation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from stlc.controller.options import bounded
from stlc.diagnostics import usage
from stlc.dynamics.model.controls import raw_width, squash

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver

MOST = 4_000_000
"""Maximum number of plan entries that are judged at a time."""
SAME = 1e-5
"""Change of the elites' mean at which the search from an initial state has converged and begins anew."""


class _Space(Protocol):
    """Space of vectors, (d,), from which the cross-entropy method samples; each vector represents a plan."""

    def centre(self, start: Tensor) -> Tensor:
        """Mean vectors of the first populations, (k, d).

        `start`: initial guesses of k plans, (k, T, m), on which the mean vectors may depend.
        """

    def deviation(self, x0: Tensor) -> Tensor:
        """Standard deviation of each component of the first population: (d,), or (1,) if all are equal."""

    def plans(self, x0: Tensor, vectors: Tensor) -> Tensor:
        """Plans that the vectors `vectors` represent, (k, p, T, m).

        `x0`: initial states, (k, n). `vectors`: p vectors per state, (k, p, d).
        """


@dataclass(frozen=True, slots=True)
class Cem:
    """Cross-entropy method: a Gaussian is fitted to the most robust of its samples.

    Attributes:
        population: number of samples per round.
        elites: number of samples, the most robust ones, to which the Gaussian is fitted.
        deviation: standard deviation of the first population, in units of half the width of each control's
            range. With `over=policy` it is the standard deviation of the weights, without unit.
        physical: whether `deviation` is in the physical units of the controls instead.
        floor: least standard deviation, in the units of `deviation`.
        rounds: maximum number of rounds, after which the search from an initial state begins anew.
        over: `plan` to sample plans; `policy` to sample the weights of a network with `hidden` ReLU units.
        hidden: number of hidden units of the network.
    """

    population: int = bounded(1_000, 1, 10**6)
    elites: int = bounded(100, 1, 10**6)
    deviation: float = bounded(0.5, 1e-9, 1e6)
    physical: bool = False
    floor: float = bounded(0.01, 0, 1e6)
    rounds: int = bounded(50, 1, 10**9)
    over: str = "plan"
    hidden: int = bounded(16, 1, 4096)

    def prepare(self, task: Task) -> Solver:
        """Return a function that searches for plans by the cross-entropy method.

        Raises:
            UsageError: U101, `over` is neither `plan` nor `policy`.
        """
        if self.over not in ("plan", "policy"):
            raise usage(f"`over={self.over}` of planner `cem` is neither `plan` nor `policy`")
        space = _Plans(task, self) if self.over == "plan" else _Policies(task, self)
        return lambda search: self._run(search, space)

    def _run(self, search: PlanSearch, space: _Space) -> None:
        entries = search.task.system.horizon * len(search.task.system.control_names) * self.population
        while len(rows := search.open()):
            for part in torch.split(rows, max(1, MOST // entries)):
                self._search(search, part, space)

    def _search(self, search: PlanSearch, rows: Tensor, space: _Space) -> None:
        """Make up to `rounds` rounds for each of the initial states with indices `rows`, (k,).

        The rounds for a state end when the Gaussian has converged, a plan has reached the target robustness,
        or the budget of the state is spent.
        """
        mean = space.centre(search.start[rows])
        wide = space.deviation(search.states[rows]).expand_as(mean).clone()
        least = wide * self.floor / self.deviation
        for _ in range(self.rounds):
            going = torch.isin(rows, search.open()).nonzero()[:, 0]
            if not len(going):
                return
            with search.charged(rows[going]):
                count = search.affordable(rows[going], self.population)
                noise = torch.randn(len(going), count, mean.shape[1], generator=search.generator).double()
                sampled = mean[going, None] + wide[going, None] * noise
                rho = search.offer(rows[going], space.plans(search.states[rows[going]], sampled))
                best = torch.nan_to_num(rho, nan=-torch.inf).topk(min(self.elites, count), dim=1).indices
                chosen = sampled.gather(1, best[..., None].expand(-1, -1, sampled.shape[2]))
                fitted = chosen.mean(1)
                same = (fitted - mean[going]).abs().amax(1) <= SAME
                mean[going] = fitted
                wide[going] = torch.maximum(chosen.std(1, unbiased=False), least[going])
            rows, mean, wide, least = (
                torch.cat((part[going][~same], part[:0])) for part in (rows, mean, wide, least)
            )


class _Plans:
    """Space of whole plans: a sampled vector contains all T m controls of a plan."""

    def __init__(self, task: Task, how: Cem) -> None:
        system = task.system
        low, high = system.control_low.double(), system.control_high.double()
        unit = torch.ones_like(low) if how.physical else 0.5 * (high - low)
        self._shape = (task.system.horizon, len(low))
        self._low, self._high = low, high
        self._wide = (how.deviation * unit).expand(self._shape).reshape(-1)

    def centre(self, start: Tensor) -> Tensor:
        return start.flatten(1).clone()

    def deviation(self, x0: Tensor) -> Tensor:  # noqa: ARG002 - the same for all states
        return self._wide

    def plans(self, x0: Tensor, vectors: Tensor) -> Tensor:  # noqa: ARG002
        return vectors.view(*vectors.shape[:2], *self._shape).clamp(self._low, self._high)


class _Policies:
    """Space of the weights of a small policy network, with one hidden layer from observations to controls."""

    def __init__(self, task: Task, how: Cem) -> None:
        self._task, self._hidden, self._std = task, how.hidden, how.deviation
        self._inputs, self._outputs = task.system.observed_count, raw_width(task.system.decl.controls)
        states = task.system.observe(task.sample(1_000, seed=0)).double()
        self._centre, self._spread = states.mean(0), states.std(0).clamp(min=1e-6)

    def centre(self, start: Tensor) -> Tensor:
        count = (self._inputs + 1) * self._hidden + (self._hidden + 1) * self._outputs
        return start.new_zeros(len(start), count)

    def deviation(self, x0: Tensor) -> Tensor:
        return x0.new_full((1,), self._std)

    def plans(self, x0: Tensor, vectors: Tensor) -> Tensor:
        rows, count = vectors.shape[:2]
        sizes = (self._inputs, 1, self._outputs, 1)
        widths = (self._hidden, self._hidden, self._hidden, self._outputs)
        flat = vectors.flatten(0, 1)
        lengths = [size * width for size, width in zip(sizes[:2], widths[:2], strict=True)]
        lengths += [self._hidden * self._outputs, self._outputs]
        first, shift, last, offset = torch.split(flat, lengths, 1)
        first = first.view(-1, self._inputs, self._hidden)
        last = last.view(-1, self._hidden, self._outputs)
        system, x, actions = self._task.system, x0.repeat_interleave(count, 0), []
        for _ in range(self._task.system.horizon):
            seen = (system.observe(x) - self._centre) / self._spread
            inner = torch.relu(torch.baddbmm(shift[:, None], seen[:, None], first))
            raw = torch.baddbmm(offset[:, None], inner, last)[:, 0]
            actions.append(squash(raw, system.decl.controls))
            x = system.step(x, actions[-1])
        return torch.stack(actions, 1).view(rows, count, self._task.system.horizon, -1)


PLANNER = Cem
