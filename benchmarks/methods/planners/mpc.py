"""`mpc`: nonlinear programming by CasADi (Andersson et al. 2019) and IPOPT, which the extra `bench` installs.

This planner applies to smooth systems. It uses multiple shooting with the smooth robustness of Pant et al.
(2017), from several initial guesses. `simulate --method mpc` plans anew in every step: model predictive
control (Sadraddini & Belta 2015).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.options import bounded
from stlc.controller.search.local_search import Searcher
from stlc.diagnostics import usage
from stlc.dynamics.model.step import build_step
from stlc.extras import needed

if TYPE_CHECKING:
    from benchmarks.methods.planners._shooting import Shooting
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver

PIECES = 5
"""Number of constant pieces of a random guess."""
ROUNDS = 2
"""Maximum number of programs solved from a guess; the second one has a larger margin."""
NEARLY = 0.1
"""Violation of the first program above which the second one is not tried."""


@dataclass(frozen=True, slots=True)
class Mpc:
    """Nonlinear program for each initial state, solved from one guess after the other.

    The search for a state ends when a plan reaches the target robustness.

    Attributes:
        guesses: number of guesses; the first is the initial guess of the search, the others are random
            controls that are constant over five pieces.
        drawn: number of random plans that are judged for one guess; the most robust of them is taken.
        iterations: maximum number of iterations of the interior-point method from each guess.
        smoothing: k of log-sum-exp, which replaces minima and maxima inside conditions; larger is sharper.
        sharpness: greatest slope of the smooth functions, with values from 0 to 1, that replace conditions.
        margin: robustness that the program demands in addition to the target, since its smooth functions only
            approximate the exact robustness.
        repair: number of plans that a local search tries if the best plan nearly reaches the target.
    """

    guesses: int = bounded(12, 1, 10**6)
    drawn: int = bounded(16, 1, 10**6)
    iterations: int = bounded(100, 1, 10**6)
    smoothing: float = bounded(50.0, 1e-9, 1e9)
    sharpness: float = bounded(20.0, 1e-9, 1e9)
    margin: float = 0.01
    repair: int = bounded(100, 0, 10**9)

    def prepare(self, task: Task) -> Solver:
        """Return a function that searches for plans by solving the nonlinear program of the task.

        Raises:
            UsageError: U101, the system or the specification is discontinuous; the message shows the
                expression.
            MissingError: R301, CasADi is not installed.
        """
        casadi = needed("casadi", "planner `mpc` needs")
        shooting = self._shooting(task)
        options: dict[str, Any] = {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.max_iter": self.iterations,
            "ipopt.tol": 1e-3,
            "ipopt.constr_viol_tol": 1e-4,
            "ipopt.acceptable_tol": 1e-2,
            "ipopt.acceptable_iter": 3,
            "ipopt.mu_strategy": "adaptive",
        }
        solver = casadi.nlpsol("plan", "ipopt", shooting.program, options)
        return partial(self._run, shooting=shooting, solve=solver)

    def _shooting(self, task: Task) -> Shooting:
        from benchmarks.methods.planners._shooting import (
            NotSmoothError,
            ScaledFormula,
            Shooting,
            ShootingDynamics,
        )
        from stlc.compile.semantics.kinds.smooth import LogSumExp

        system = task.system
        free = build_step(replace(system.decl, clamps={}), soft=False)
        bounds = zip(system.control_low.tolist(), system.control_high.tolist(), strict=True)
        step = {**free.next, **{timer.name: timer.update for timer in system.timers}}
        named = dict(zip(system.control_names, bounds, strict=True))
        motion = ShootingDynamics(free.lets, step, system.decl.clamps, named, system.horizon)
        rules = [ScaledFormula(rule.under(LogSumExp()), rule.factor) for rule in task.rules]
        try:
            return Shooting(motion, rules, smoothing=self.smoothing, sharpness=self.sharpness)
        except NotSmoothError as what:
            raise usage(
                f"planner `mpc` cannot plan through jumps: {what}",
                "search plans for any system, milp for piecewise linear ones",
            ) from None

    def _run(self, search: PlanSearch, shooting: Shooting, solve: Callable[..., Any]) -> None:
        searcher = Searcher(search.task, search.generator, target=search.budget.target or TOLERANCE)
        for row in search.open().tolist():
            for number in range(self.guesses):
                if row not in search.open():
                    break
                rows = torch.tensor([row])
                with search.charged(rows):
                    guess = self._guess(search, row, number)
                    if row in search.open():
                        self._improve(search, rows, guess, shooting, solve)
                    if row in search.open():
                        self._mend(search, rows, searcher)
            search.ended[row] = True

    def _improve(
        self, search: PlanSearch, rows: Tensor, guess: Tensor, shooting: Shooting, solve: Callable[..., Any]
    ) -> None:
        """Solve the program for one initial state, starting from the plan `guess`, (T, m).

        `rows`: index of the state, (1,). The solution is offered to `search`, which keeps the best plan. A
        solution may have an exact robustness below the target, since the program uses smooth functions. The
        program is then solved once more with a larger margin, unless the solution violates its conditions by
        much.
        """
        target = search.budget.target
        maximise = math.isinf(target)
        limits = shooting.limits(maximise=maximise)
        margin = 0.0 if maximise else target + self.margin
        for _ in range(ROUNDS):
            moved = search.task.system.rollout_columns(search.states[rows], guess[None])
            known = {name: column[:, 0].numpy() for name, column in moved.items()}
            found = solve(x0=shooting.guess(guess.numpy(), known), p=shooting.data(known, margin), **limits)
            values = np.array(found["x"])[:, 0]
            guess = torch.nan_to_num(torch.from_numpy(shooting.controls(values).copy()))
            rho = float(search.offer(rows, guess[None])[0])
            if maximise or rho >= target or values[-1] > NEARLY or not len(search.open()):
                return
            margin += self.margin + target - rho

    def _mend(self, search: PlanSearch, rows: Tensor, searcher: Searcher) -> None:
        """Improve the best plan from one initial state by local search, if it nearly reaches the target.

        `rows`: index of the state, (1,).
        """
        missed = search.budget.target - float(search.rho[rows])
        if self.repair and TOLERANCE < missed <= NEARLY:
            tries = search.allowed(rows, self.repair)
            found = searcher.repair(search.states[rows], search.plans[rows], tries=tries, threads=1)
            search.offer(rows, found.plans, evaluations=tries)

    def _guess(self, search: PlanSearch, row: int, number: int) -> Tensor:
        """Guess of a plan, (T, m) float64.

        For `number` 0 it is the initial guess of the search, else the most robust of some random plans.
        """
        if not number:
            return search.start[row]
        count = search.allowed(torch.tensor([row]), self.drawn)
        system, shape = search.task.system, (count, PIECES)
        low, high = system.control_low.double(), system.control_high.double()
        held = torch.rand(*shape, len(low), generator=search.generator).double()
        length = math.ceil(system.horizon / PIECES)
        plans = (low + (high - low) * held).repeat_interleave(length, 1)[:, : system.horizon]
        x0 = search.states[row].expand(count, -1)
        search.evaluations[row] += count
        return plans[search.task.judge(x0, plans, states=False).rho.argmax()]


PLANNER = Mpc
