"""The paper's backup policy: sampled prefixes, finished by the policy ("MPC-based Deployment with a Backup Policy").

For T0 = 1, 2, … every sequence of T0 actions on a grid of L values a control, M = L^(m T0), is followed from the state at
hand, and the policy plans on from where it ends. The first T0 with a plan that satisfies phi, or else phi_safe, decides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, Protocol, TypeAlias

import torch
from torch import Tensor

from stlc.compile.semantics import TOLERANCE
from stlc.controller.prefix import safe_samples
from stlc.controller.task import Task

Aim: TypeAlias = Literal["phi", "safe", "prefix"]

TIE = 1e-9


class Planner(Protocol):
    """What plans: a network, a search, a rule."""

    def plan(self, x0: Tensor) -> Tensor:
        """(batch, states) -> (batch, horizon, controls), physical units."""


@dataclass(frozen=True, slots=True)
class Grid:
    """What is tried: `values` a control, prefixes of each of `lengths`, at most `batch` trajectories at a time."""

    values: tuple[tuple[float, ...], ...]
    lengths: tuple[int, ...]
    batch: int

    @classmethod
    def of(cls, task: Task) -> Grid:
        """The grid that the system declares: `levels` of a control, else evenly spaced over its range."""
        decl = task.system.decl
        values = tuple(
            control.levels or tuple(torch.linspace(control.low, control.high, decl.backup.bins).tolist())
            for control in decl.controls
        )
        lengths = tuple(length for length in decl.backup.lengths if 0 < length < task.horizon)
        return cls(values, lengths, decl.backup.batch)

    def prefixes(self, length: int) -> Tensor:
        """All prefixes, (M, length, m) float64."""
        actions = torch.tensor(list(product(*self.values)), dtype=torch.float64)
        index = torch.cartesian_prod(*[torch.arange(len(actions))] * length)
        return actions[index.reshape(-1, length)]


@dataclass(frozen=True, slots=True)
class Found:
    """The plans that the backup chose.

    Attributes:
        plan: (agents, horizon, controls) float64.
        t0: (agents,) int64, length of the prefix.
        rho: (agents,) float64, robustness of phi.
        safe: (agents,) bool, whether phi_safe holds.
    """

    plan: Tensor
    t0: Tensor
    rho: Tensor
    safe: Tensor


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Plans of several agents from one state each: (agents, choices, …); choice 0 is the policy's own."""

    x: Tensor
    plans: Tensor
    rho: Tensor
    safe: Tensor


class Backup:
    """The backup policy of a task.

    Args:
        task: specification and system.
        planner: who finishes the prefixes.
        grid: what is tried; by default what the system file says.
    """

    def __init__(self, task: Task, planner: Planner, *, grid: Grid | None = None) -> None:
        self.task, self.planner = task, planner
        self.grid = grid or Grid.of(task)

    def search(self, x: Tensor, plan: Tensor) -> Found:
        """Better plans for states whose own plan was found wanting.

        Args:
            x: (agents, n) float64.
            plan: (agents, T, m) float64, what the policy would do.
        """
        agents = len(x)
        found = Found(
            plan.clone(),
            torch.zeros(agents, dtype=torch.int64, device=x.device),
            torch.full((agents,), -torch.inf, dtype=torch.float64, device=x.device),
            torch.zeros(agents, dtype=torch.bool, device=x.device),
        )
        open_ = torch.arange(agents, device=x.device)
        for length in self.grid.lengths:
            prefixes = self.grid.prefixes(length).to(x.device)
            last = length == self.grid.lengths[-1]
            left = [
                self._settle(found, group, (x, plan, prefixes), last=last)
                for group in open_.split(max(self.grid.batch // (len(prefixes) + 1), 1))
            ]
            open_ = torch.cat(left) if left else open_
            if not len(open_):
                break
        return found

    def _settle(
        self, found: Found, group: Tensor, given: tuple[Tensor, Tensor, Tensor], *, last: bool
    ) -> Tensor:
        """Enter the choices of one T0 for some agents; returns those that are still open."""
        x, plan, prefixes = given
        candidates = self._candidates(x[group], plan[group], prefixes)
        satisfied, safe = candidates.rho >= -TOLERANCE, candidates.safe
        eligible = torch.where(satisfied.any(1, keepdim=True), satisfied, safe)
        done = eligible.any(1)
        for rows, aim in ((done, "rho"), (~done if last else torch.zeros_like(done), "prefix")):
            if bool(rows.any()):
                part = _Candidates(*(value[rows] for value in _fields(candidates)))
                allowed = eligible[rows] if aim == "rho" else self._longest(part)
                pick = self._best(part, allowed)
                row = torch.arange(len(pick), device=x.device)
                at = group[rows]
                found.plan[at], found.t0[at] = part.plans[row, pick], prefixes.shape[1]
                found.rho[at], found.safe[at] = part.rho[row, pick], part.safe[row, pick]
        return group[~done]
