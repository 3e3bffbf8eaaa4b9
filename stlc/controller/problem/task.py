"""Task: a specification compiled for a system; initial states, rollouts, robustness and verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from stlc.compile.backends.array.graph import RobustnessGraph, evaluate
from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import emit
from stlc.compile.backends.schedule import End
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.frontend.parameters import fixed
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import Compiled, CompiledRequirement, compile_spec
from stlc.compile.semantics.switch import Hard, Switch
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.native import NativeGradient, NativeJudge, motion_of, reason
from stlc.controller.problem.pending_goals import PendingGoals
from stlc.diagnostics import usage
from stlc.dynamics.model.cost import PlanCost
from stlc.dynamics.scenario import scenario_constants
from stlc.dynamics.system import System, check_plans
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.runtime.decision import rank
from stlc.tabular import html_table

HARD = Hard()
ROUNDS = 5
"""Number of periods for which a mission with requirements that recur forever is simulated."""
MOST_MISSED, UNSAFE = 1e9, 1e6
"""Greatest shortfall of a requirement that counts, and what an unsafe plan is worth less than a safe one."""
LONGEST = 500
"""Most steps of a plan that reaches beyond the horizon of the system, to the end of a mission."""
MOST_VALUES = 32_000_000
"""Maximum number of values that torch holds while it judges plans: 256 MB in float64."""
HINT = "--system FILE"
"""Advice that most commands print if no system is named."""
GUIDANCE = 0.1
"""Weight of the guidance cost towards the next goal among the performance terms."""
GOALS = 3.0
"""Weight among the performance terms of the amounts by which margins of pending goals are below gamma."""
SHORTFALL = 10.0
"""Weight of the amount by which robustness is below gamma, in the cost that selects plans of a mission."""


@dataclass(frozen=True, slots=True)
class PlanVerdicts:
    """Exact verdicts on a batch of plans, without gradient.

    Attributes:
        rho: robustness of the whole specification, (batch,).
        safe: robustness of phi_safe (the requirements tagged `@safety`), (batch,); +inf if there are none.
        requirements: robustness per requirement, before weight and scale, (batch, requirements).
        plans: the judged plans, (batch, T, m).
        columns: the predicted states, name -> (time, batch); empty if they were not asked for.
    """

    rho: Tensor
    safe: Tensor
    requirements: Tensor
    plans: Tensor
    columns: Mapping[str, Tensor]

    @property
    def satisfied(self) -> Tensor:
        """Mask of the plans that satisfy the specification, (batch,)."""
        return TOLERANCE.satisfied(self.rho)

    def of(self, index: Tensor) -> PlanVerdicts:
        """The verdicts on the plans with indices `index`, (k,)."""
        columns = {name: column[:, index] for name, column in self.columns.items()}
        return PlanVerdicts(
            self.rho[index], self.safe[index], self.requirements[index], self.plans[index], columns
        )

    def put(self, index: Tensor, other: PlanVerdicts) -> PlanVerdicts:
        """Copy of these verdicts, in which `other` replaces those on the plans with indices `index`, (k,)."""
        columns = {
            name: column.index_copy(1, index, other.columns[name]) for name, column in self.columns.items()
        }
        return PlanVerdicts(
            self.rho.index_copy(0, index, other.rho),
            self.safe.index_copy(0, index, other.safe),
            self.requirements.index_copy(0, index, other.requirements),
            self.plans.index_copy(0, index, other.plans),
            columns,
        )


class Task:
    """A specification compiled for a system: the problem for which a policy is trained.

    Attributes:
        compiled: the specification in discrete time, with the timers and parameters that it adds to the
            state.
        plain: the system of the system file, without these timers and parameters.
        system: the system whose last states are the timers and parameters of the specification, and whose
            initial states satisfy its assumptions on them.
        graph: function that computes the robustness of the whole specification.
        safety: function that computes the robustness of phi_safe (the requirements tagged `@safety`).
    """

    def __init__(self, compiled: Compiled, system: System) -> None:
        self.compiled = compiled
        if (steps := compiled.grid.steps) is not None and steps != system.horizon:
            system = system.planned_for(steps)
        self.plain = system
        known = {*system.decl.signature.names}
        conditions = {
            f"assume {rule.name}": rule.formula
            for rule in compiled.assumptions
            if rule.typed.formula.is_state() and rule.formula.columns <= known
        }
        if conditions:
            system = system.assuming(conditions)
        added = compiled.timers, compiled.parameters
        self.system = system.augmented(*added) if any(added) else system
        self.graph = RobustnessGraph(compiled.requirements, self.system.signature, end=compiled.end)
        self.safety = RobustnessGraph(compiled.safety, self.system.signature, end=compiled.end)

    def __deepcopy__(self, memo: object) -> Self:
        """Return the task itself, which is immutable: a copied network belongs to the same task."""
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Task, (self.compiled, self.plain)

    @classmethod
    def load(
        cls,
        spec: Path | str,
        system: Path | str | None = None,
        overrides: Mapping[str, str] | None = None,
        *,
        hint: str = HINT,
        found: Callable[[Path], None] | None = None,
        scenario: str | None = None,
        whole: bool = False,
    ) -> Task:
        """Load a specification and a system, and compile the specification for the system.

        Args:
            spec: specification file, searched by `File.spec`.
            system: system file, found by `File.system`; by default the one that the specification names.
            overrides: constants of the specification and keys of the system file to change, name -> text.
            hint: what the user may do if no system is named.
            found: function that receives the path of the system file before it is read.
            scenario: name of a scenario of the system file to apply.
            whole: whether plans reach to the end of a deployment (`Task.of`).

        Raises:
            UsageError: U101, no system is named, or there is no such scenario; U102, there is no such file.
            SpecError: the specification is invalid or does not fit the system.
            SystemFileError: the system file is invalid.
        """
        path = File(spec).spec()
        parsed = Spec.parse(File(path).read())
        wanted = system if system is not None else parsed.system
        if wanted is None:
            raise usage(f"`{path}` names no system", hint, 'or a line `system "FILE"` in the specification')
        there = File(wanted).system(path)
        if found is not None:
            found(there)
        changed = dict(overrides or {})
        if scenario is not None:
            changed = {**scenario_constants(there, scenario, changed), **changed}
        found_system = System.load(there, changed, scenario=scenario)
        return cls.of(parsed, found_system, overrides=changed, whole=whole)

    @classmethod
    def of(
        cls,
        spec: Spec,
        system: System,
        *,
        overrides: Mapping[str, str] | None = None,
        values: Mapping[str, str] | None = None,
        end: End = "strict",
        whole: bool = False,
    ) -> Task:
        """Compile a specification for a system.

        If it has deadlines, or a mission is no longer than a plan, plans may reach to the end of a mission
        (`whole`, or the key `mission` of the system file), and then end there. Otherwise they have the
        horizon of the system.

        Args:
            spec: parsed specification.
            system: system that the specification is about.
            overrides: constants to change, name -> text such as `3 s`; a parameter becomes a constant.
            values: parameters that get one fixed value in all trajectories; the policy still observes them.
            end: "truncate" cuts windows that extend beyond the end of the plan; "strict" refuses them.
            whole: whether plans reach to the end of a deployment, unless the system file says otherwise.

        Raises:
            UsageError: a value in `overrides` or `values` is not admissible.
            SpecError: the specification is invalid, or does not fit the system.
        """
        decl, interface, overrides = system.decl, system.interface(), overrides or {}
        compiled = compile_spec(spec, grid=decl.grid, interface=interface, overrides=overrides, end=end)
        last = decl.test.steps if whole and decl.mission is None else decl.mission
        ends = compiled.mission is not None or (last is not None and last <= decl.horizon)
        if ends and compiled.recurring is None and last:
            grid = Grid(decl.dt, decl.horizon, max(decl.horizon, min(last, LONGEST)), last)
            compiled = compile_spec(spec, grid=grid, interface=interface, overrides=overrides, end=end)
        if values:
            compiled = replace(compiled, parameters=fixed(compiled.parameters, values))
        return cls(compiled, system)

    @property
    def safety_task(self) -> Task:
        """A task with the requirements tagged `@safety` as its only specification."""
        return Task(replace(self.compiled, requirements=self.compiled.safety), self.plain)

    def require_controls(self, who: str = "a policy") -> None:
        """Raise UsageError (U101) if the system has no control.

        `who` names, in the message, what would choose the controls: `a policy` or `a guard`.
        """
        if self.system.decl.controls:
            return
        message = f"the system `{self.system.decl.name}` has no control: {who} has nothing to choose"
        raise usage(
            message, "`stlc plan SPEC` judges it from random initial states", "control: {u: {range: [-1, 1]}}"
        )

    def __repr__(self) -> str:
        return f"Task({self.compiled.name} on {self.system.facts})"

    def _repr_html_(self) -> str:
        rules = self.compiled.requirements
        rows = [(rule.name, ", ".join(rule.tags), " ".join((rule.doc or "").split())) for rule in rules]
        title = f"{self.compiled.name} on {self.system.facts}"
        return html_table(title, ("requirement", "tags", "says"), rows)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states, in the order of their columns; those that the specification adds are last."""
        return self.system.names

    @property
    def horizon(self) -> int:
        """Number of steps of a plan: the horizon of the system, or more if plans reach to a mission's end."""
        return self.system.horizon

    @property
    def window(self) -> int:
        """Number of steps that `T` stands for in the specification: the horizon of the system."""
        return self.system.decl.horizon

    @property
    def clock(self) -> int | None:
        """Index of the state that counts the steps of a mission, negative; None if there is none.

        The timers come last in states and in observations, so that it is the index of both.
        """
        kinds = [timer.kind for timer in self.compiled.timers]
        return kinds.index("clock") - len(kinds) if "clock" in kinds else None

    @property
    def mission_steps(self) -> int:
        """Number of steps for which a mission is simulated.

        If no requirement refers to times since the start of the mission, a mission takes four horizons.
        Otherwise let t be the last time to which a requirement refers. The mission ends one horizon after t.
        If requirements recur forever, it ends `ROUNDS` periods after t instead. Here a period is taken as at
        least one horizon.
        """
        named, recurring = self.compiled.mission, self.compiled.recurring
        if self.compiled.grid.end is not None:
            return self.compiled.grid.end
        if named is None:
            return self.horizon * 4
        if recurring is None:
            return named + self.horizon
        return named + ROUNDS * max(self.horizon, recurring)

    @property
    def rules(self) -> tuple[CompiledRequirement, ...]:
        """The compiled requirements, in the order of the specification."""
        return self.compiled.requirements

    @cached_property
    def _safe_indices(self) -> list[int]:
        names = [rule.name for rule in self.rules]
        return [names.index(rule.name) for rule in self.compiled.safety]

    def sample(
        self,
        n: int,
        *,
        seed: int | None = None,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw `n` random initial states, (n, dim), with the method `System.sample`."""
        return self.system.sample(n, seed=seed, generator=generator, dtype=dtype, device=device)

    def rollout(self, x0: Tensor, u: Tensor, switch: Switch | None = None) -> Tensor:
        """States under plans: (B, n), (B, T, m) -> (B, T+1, n).

        `switch` gives the form of jumps and conditions, exact by default. The native kernel is used if no
        gradient is needed and the plans have at most `horizon` steps.
        """
        differentiated = torch.is_grad_enabled() and (x0.requires_grad or u.requires_grad)
        soft = switch is not None and not switch.exact
        apart = differentiated or soft or u.shape[1] > self.horizon
        if apart or not len(x0) or x0.device.type != "cpu" or self.native is None:
            return self.system.rollout(x0, u, switch)
        whole = u.new_zeros((len(u), self.horizon, u.shape[2]))
        whole[:, : u.shape[1]] = u
        _, columns = self.native.judge(x0, whole, columns=True)
        return torch.stack([columns[name][: u.shape[1] + 1].t() for name in self.system.names], 2)

    def robustness(self, x: Tensor, smoothing: float | None = None) -> Tensor:
        """Robustness of trajectories at time 0: (B, T+1, n) -> (B,).

        The robustness is exact if `smoothing` is None. Otherwise it is smooth, with the parameter k =
        `smoothing` (Meng and Fan 2023, Eq. 4 and 7).
        """
        rho: Tensor = self.graph.robustness(x, smoothing)
        return rho

    def requirement_robustness(self, x: Tensor, smoothing: float | None = None) -> Tensor:
        """Robustness of trajectories per requirement, before weight and scale: (B, T+1, n) -> (B, R)."""
        each: Tensor = self.graph.per_requirement(x, smoothing)
        return each

    @cached_property
    def native(self) -> NativeJudge | None:
        """Native kernel for verdicts and local search, without gradient; None if torch has to be used."""
        return NativeJudge.of(self.system, self.rules, self.compiled.end)

    @cached_property
    def gradient(self) -> NativeGradient | None:
        """Native kernel for robustness and states, differentiable with respect to the plans.

        None if torch has to be used.
        """
        return NativeGradient.of(self.system, self.rules, self.native, self.compiled.end)

    def torch_reasons(self, device: str, *, searches: bool, smooth: bool) -> Mapping[str, str]:
        """For each part of a training run, the reason why this part runs in torch; "" if it runs in C.

        The keys of the mapping are `verdicts` (on plans), `search` (for better plans), and `gradient` (of the
        robustness).

        Args:
            device: type of the torch device.
            searches: whether the training searches for plans.
            smooth: whether the objective of the training uses smooth robustness, which has no native
                gradient.
        """
        if device != "cpu":
            return dict.fromkeys(("verdicts", "search", "gradient"), f"the device is {device}")
        motion, formulas = motion_of(self.system), [rule.formula for rule in self.rules]
        judged = "" if self.native is not None else reason(lambda: emit(motion, formulas, self.compiled.end))
        if smooth:
            gradient = "the paper's objective is smooth"
        elif judged or self.gradient is not None:
            gradient = judged
        else:
            gradient = reason(lambda: emit_adjoint(motion, formulas, end=self.compiled.end))
        return {"verdicts": judged, **({"search": judged} if searches else {}), "gradient": gradient}

    def judge(self, x0: Tensor, u: Tensor, *, states: bool = True) -> PlanVerdicts:
        """Roll out and judge plans exactly, without gradient.

        Args:
            x0: initial states, (B, n).
            u: plans in physical units, (B, T, m).
            states: whether to return the predicted states, which `cost` needs.

        Returns:
            The verdicts, in the dtype of `x0`. A plan that holds NaN counts as violated (robustness -inf).

        Raises:
            ValueError: `x0` or `u` has another shape.
        """
        names, controls = self.system.names, self.system.control_names
        sizes = {"states": len(names), "controls": len(controls), "steps": self.horizon}
        check_plans(self.system.decl.name, tuple(x0.shape), tuple(u.shape), **sizes)
        with torch.no_grad():
            u = u.to(x0.dtype)
            each, columns = self._judged(x0, u, states=states)
            rho = self.graph.overall(each)
            safe = self.safety.overall(each[:, self._safe_indices])
        broken = ~torch.isfinite(u).all(2).all(1) | torch.isnan(rho)
        if bool(broken.any()):
            lost = torch.full_like(rho, -torch.inf)
            rho, safe = torch.where(broken, lost, rho), torch.where(broken, lost, safe)
            each = torch.where(broken[:, None], lost[:, None], each)
        return PlanVerdicts(rho, safe, each, u, columns)

    def _judged(self, x0: Tensor, u: Tensor, *, states: bool) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Robustness per requirement (B, R) and predicted states name -> (T+1, B), in C if possible."""
        if x0.device.type == "cpu" and self.native is not None:
            return self.native.judge(x0, u, columns=states)
        rows = max(1, MOST_VALUES // self._values_of_a_row)
        if len(x0) <= rows:
            return self._judged_by_torch(x0, u)
        parts = [
            self._judged_by_torch(*part)
            for part in zip(torch.split(x0, rows), torch.split(u, rows), strict=True)
        ]
        each = torch.cat([each for each, _ in parts])
        if not states:
            return each, {}
        return each, {name: torch.cat([part[name] for _, part in parts], 1) for name in self.system.names}

    def _judged_by_torch(self, x0: Tensor, u: Tensor) -> tuple[Tensor, Mapping[str, Tensor]]:
        columns = self.system.rollout_columns(x0, u)
        each = self.graph.per_requirement_columns(columns, ops=TORCH)
        for name in self._moving:
            each = torch.where(columns[name][1:].isnan().any(0)[:, None], torch.nan, each)
        return each, columns

    @cached_property
    def _moving(self) -> tuple[str, ...]:
        """Names of the states that change along a plan; a plan on which one is NaN is violated."""
        return tuple(motion_of(self.system).next)

    @cached_property
    def timed(self) -> Tensor:
        """Mask of the requirements that read clock, statuses or timers, (R,)."""
        return torch.tensor(
            [any(each.guard for each in rule.formula.predicates()) for rule in self.rules],
            dtype=torch.bool,
        )

    @cached_property
    def _values_of_a_row(self) -> int:
        """Approximate number of values that torch holds per plan while it judges plans."""
        parts = sum(1 for rule in self.rules for _ in rule.formula.walk())
        return (self.horizon + 1) * (
            2 * len(self.system.names) + 2 * len(self.system.control_names) + 4 * parts
        )

    def cost(self, judged: PlanVerdicts) -> Tensor:
        """Cost by which satisfying plans are compared, without gradient: (batch,).

        It is the value of the method `performance`. In a mission (a specification that adds timers to the
        state), the guidance cost (distance to the next goal) would draw plans to the boundary of the
        constraints. Therefore the cost of a plan increases if its robustness is below gamma, the margin that
        plans should have: the missing robustness, times a weight, is added.
        """
        with torch.no_grad():
            return self._summed(self.plan_cost, judged.columns, judged.rho, judged.plans)

    def rank(self, judged: PlanVerdicts, *, safety: bool = True) -> Tensor:
        """Values that rank plans, (batch,), by `stlc.runtime.decision.rank`; `safety`: safe ones first."""
        order: Tensor = rank(judged.rho, self.cost(judged), judged.safe if safety else None, TORCH)
        return order

    def preference(self, judged: PlanVerdicts) -> Tensor:
        """Values that compare plans in a search, (batch,); larger is better, and 0 or more is satisfying.

        It is the robustness. Of plans that violate a mission, a safe one is preferred, and then the one with
        the least sum of log(1 + shortfall) over the requirements: one that no plan satisfies any more does
        not hide the others.
        """
        if self.compiled.grid.end is None:
            return judged.rho
        factors = judged.requirements.new_tensor([rule.factor for rule in self.rules])
        missed = (-judged.requirements * factors).clamp(0.0, MOST_MISSED)
        lack = -torch.log1p(missed).sum(1)
        lack = torch.where(TOLERANCE.satisfied(judged.safe), lack, lack - UNSAFE)
        return torch.where(judged.rho >= 0.0, judged.rho, torch.where(judged.rho.isnan(), -torch.inf, lack))

    def performance(self, columns: Mapping[str, Tensor], rho: Tensor, u: Tensor) -> Tensor:
        """Sum of the performance terms of plans, also for plans that violate the specification: (batch,).

        In a mission (a specification that adds timers to the state), two terms are added to those of the
        system file: the margin that the plan lacks at pending goals (`PendingGoals`), and the
        guidance cost (distance to the next goal), each times a weight.

        Args:
            columns: states over time, name -> (time, batch).
            rho: robustness, (batch,).
            u: controls, (batch, T, m).
        """
        return self._summed(self._performance, columns, rho.detach(), u)

    def _summed(self, cost: PlanCost, columns: Mapping[str, Tensor], rho: Tensor, u: Tensor) -> Tensor:
        inputs = zip(self.system.control_names, u.permute(2, 1, 0).unbind(0), strict=True)
        given = dict(inputs) if cost.controlled else {}
        found: Tensor = cost(columns, given, torch.ones_like(rho)[None], rho[None], TORCH)[0]
        return found

    @cached_property
    def plan_cost(self) -> PlanCost:
        """The cost that `cost` computes, over any array library."""
        if not self.compiled.timers:
            return self._performance
        return self._performance.with_shortfall(self.system.decl.objective.gamma, SHORTFALL)

    @cached_property
    def _performance(self) -> PlanCost:
        cost = self.pending_goals.added_to(self.system.cost, GOALS)
        return cost.with_mean(self.compiled.guidance_cost, GUIDANCE)

    @cached_property
    def pending_goals(self) -> PendingGoals:
        """Goals `eventually@[a, b]` of the mission, and gamma, the margin that plans should have at them."""
        return PendingGoals(self.compiled, self.system.decl.objective.gamma)

    def alive(self, x: Tensor) -> Tensor:
        """Mask of the states in which no requirement of the mission is violated for good: (B, n) -> (B,)."""
        env = {name: column[None] for name, column in zip(self.system.names, x.unbind(1), strict=True)}
        margins = evaluate([rule.alive for rule in self.rules], env, ops=TORCH)
        return torch.stack([margin[0].expand(len(x)) >= 0.0 for margin in margins]).all(0)
