"""Torch modules of a controller and of its guard, for export with any number of agents.

The guard (Meng and Fan 2023) replaces the first T0 actions of a plan by a prefix: a sequence of actions from
a list that is fixed in advance. The policy plans the rest. The guard in stlc tries longer prefixes only if no
plan was found with shorter ones. An exported program cannot stop early. It tries the prefixes of all lengths,
and returns the same plans.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.candidates import completed, finite, first, grid_of
from stlc.controller.guard.safe_prefix import prefix_robustness
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.runtime.decision import prefix_shooting
from stlc.runtime.prefixes import PrefixGrid

if TYPE_CHECKING:
    from torch.export import ExportedProgram

    from stlc.controller.policies.policy import PlanProposer


class Deciding(nn.Module):
    """Module from states (B, n) to plan (B, T, m), rho and safe (B,), requirements (B, R); all float64.

    `rho` is the robustness of the specification under the plan, `safe` that of the safety requirements alone,
    and `requirements` that of each requirement.
    """

    def __init__(self, task: Task, network: PlanProposer) -> None:
        super().__init__()
        self.network = network
        self._task = task

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the best of the policy's plans and its verdict, equal to those of `Policy.plan_judged`."""
        plan, rho, safe, each = self.proposed(x)
        if not len(self.network.changes):
            return plan, rho, safe, each
        found = self._best(x, self.network.with_changes(plan))
        pairs = zip((plan, rho, safe, each), found, strict=True)
        good = TOLERANCE.satisfied(rho)
        plan, rho, safe, each = (
            torch.where(good.view(-1, *[1] * (own.dim() - 1)), own, other) for own, other in pairs
        )
        return plan, rho, safe, each

    def proposed(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the best of the network's own plans and its verdict, without trying changed copies of plans.

        The plan is that of `Policy.continuation`.
        """
        return self._best(x, self.network(x).to(x.dtype))

    def _best(self, x: Tensor, plans: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the best of the plans (B, count, T, m) in states (B, n), and its verdict."""
        _, count, steps, controls = plans.shape
        starts = x[:, None].expand(-1, count, -1).reshape(-1, x.shape[1])
        flat = plans.reshape(-1, steps, controls)
        judged = judged_by_torch(self._task, starts, flat)
        score = self._task.rank(judged).view(-1, count)
        rows = (flat, judged.rho, judged.safe, judged.requirements)
        split = [row.reshape(-1, count, *row.shape[1:]) for row in rows]
        plan, rho, safe, each = _picked(split, score.argmax(1))
        return plan, rho, safe, each


def judged_by_torch(task: Task, x: Tensor, plans: Tensor) -> PlanVerdicts:
    """Evaluate plans as `Task.judge` does, but only with operations that torch can export."""
    columns = task.system.rollout_columns(x, plans)
    each = task.graph.per_requirement_columns(columns, ops=TORCH)
    names = [rule.name for rule in task.rules]
    rho = task.graph.overall(each)
    safe = task.safety.overall(each[:, [names.index(rule.name) for rule in task.compiled.safety]])
    broken = ~torch.isfinite(plans).all(2).all(1) | torch.isnan(rho)
    rho, safe = rho.masked_fill(broken, -torch.inf), safe.masked_fill(broken, -torch.inf)
    return PlanVerdicts(rho, safe, each.masked_fill(broken[:, None], -torch.inf), plans, columns)


@contextmanager
def without_deprecations() -> Iterator[None]:
    """Suppress the deprecation warnings that torch's export raises about torch itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def recorded(task: Task, network: PlanProposer) -> ExportedProgram:
    """Return the controller as an exported torch program for any number of agents; states are float64."""
    return _exported(Deciding(task, network), task.sample(3, seed=0, dtype=torch.float64))


def _exported(module: nn.Module, *inputs: Tensor) -> ExportedProgram:
    module.eval()
    with torch.no_grad(), without_deprecations():
        module(*inputs)  # cached constants are created here, not while exporting
        batch = torch.export.Dim("batch", min=1)
        shapes = tuple({0: batch} for _ in inputs)
        return torch.export.export(module, inputs, strict=False, dynamic_shapes=shapes)


# --------------------------------------------------------------------------------------- backup policy


AT_ONCE = 32_768
"""Maximum number of plans of one state that are evaluated in one batch."""

_NOTHING: tuple[Tensor, ...] = ()


@dataclass(frozen=True, slots=True)
class _Tried:
    """Plans that the guard tries with prefixes (first actions) of one length T0, and their verdicts.

    There is one choice for each prefix. `plans` and `each` are (states, choices, …); `rho`, `safe` and `cost`
    are (choices, states). `falls`, (time, choices, states), is the robustness of the safety requirements on
    every first part of a plan. It is computed for the longest prefixes only.
    """

    plans: Tensor
    rho: Tensor
    safe: Tensor
    each: Tensor
    cost: Tensor
    falls: Tensor | None


class Guarding(nn.Module):
    """Module from states (B, n) and the policy's plans (B, T, m) to the plans that the guard chooses.

    The guard is that of Meng and Fan 2023. It replaces the first actions of a plan by a prefix: a sequence of
    actions from a list that is fixed in advance. The policy plans the rest.

    Outputs in float64:
        plan (B, T, m): the chosen plan.
        rho (B,): robustness of the specification under the chosen plan.
        safe (B,): robustness of the safety requirements alone.
        requirements (B, R): robustness of each of the R requirements.

    Outputs in int64:
        source (B,): 1 if the plan satisfies the specification, or at least the safety requirements. 2 if no
            such plan was found; the plan then keeps the safety requirements for as long as possible.
        t0 (B,): number of actions in the prefix of the plan; 0 if the system file declares no prefixes.
    """

    def __init__(self, task: Task, network: PlanProposer, grid: PrefixGrid | None = None) -> None:
        super().__init__()
        self.deciding = Deciding(task, network)
        self.grid = grid or grid_of(task)
        self._task = task
        self._formulas = [rule.formula for rule in task.compiled.safety]
        self._prefixes = {
            length: torch.from_numpy(self.grid.prefixes(length)) for length in self.grid.lengths
        }

    def forward(self, x: Tensor, plan: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs of the guard for states `x` and the policy's plans `plan`.

        As the module gets no previous plan, the guard chooses as in the first step of a mission.
        """
        own = finite(plan, self._task)
        nobody = torch.zeros_like(x[:, 0])
        if not self._prefixes:
            judged = judged_by_torch(self._task, x, own)
            return own, judged.rho, judged.safe, judged.requirements, nobody.long() + 2, nobody.long()
        decided, found = torch.zeros_like(nobody, dtype=torch.bool), _NOTHING
        for shot in prefix_shooting(self.grid.lengths, lambda length: [self._tried(x, own, length)], TORCH):
            tried = shot.plans
            pick = first(shot.chosen(tried.falls))
            rows = (tried.plans, tried.rho.t(), tried.safe.t(), tried.each)
            source = torch.where(shot.found, 1, 2)
            here = (*_picked(rows, pick), source, torch.full_like(pick, shot.length))
            if found:  # decided by a shorter prefix
                here = tuple(
                    torch.where(decided.view(-1, *[1] * (old.dim() - 1)), old, new)
                    for old, new in zip(found, here, strict=True)
                )
            found, decided = here, decided | shot.found
        return found

    def _tried(self, x: Tensor, own: Tensor, length: int) -> _Tried:
        """All plans that the guard tries with prefixes of `length` actions, and their verdicts.

        A prefix consists of the first T0 actions of a plan. The policy plans the later actions, from the
        state that the prefix reaches when it starts in `x`. One more plan is tried first: its prefix is that
        of the policy's own plan `own`. For the longest prefixes, the robustness of the safety requirements is
        also computed on every initial segment of each plan.
        """
        prefixes = self._prefixes[length].expand(x.shape[0], -1, -1, -1)
        heads = torch.cat((own[:, None, :length], prefixes), 1)
        size = max(AT_ONCE // self.deciding.network.plans, 1)
        falls = length == self.grid.lengths[-1]
        pieces = [self._finished(x, some, falls=falls) for some in torch.split(heads, size, 1)]
        plans, rho, safe, each, cost, *rest = (torch.cat(column, 1) for column in zip(*pieces, strict=True))
        return _Tried(plans, rho.t(), safe.t(), each, cost.t(), rest[0].permute(2, 1, 0) if falls else None)

    def _finished(self, x: Tensor, heads: Tensor, *, falls: bool) -> list[Tensor]:
        """Complete the prefixes `heads` to plans, and judge the plans.

        `heads` is (B, C, L, m): for each of B states, C prefixes of L actions. The policy plans the later
        actions.

        Returns plans, rho, safe, requirements and cost, (B, C, …) each. If `falls` is True, a last entry
        follows: the robustness of the safety requirements on every first part of each plan.
        """
        plans = completed(
            x, heads, self._task, self._task.system.rollout, lambda ends: self.deciding.proposed(ends)[0]
        )
        count, flat = plans.shape[1], plans.flatten(0, 1)
        starts = x[:, None].expand(-1, count, -1).reshape(-1, x.shape[1])
        judged = judged_by_torch(self._task, starts, flat)
        rows = [flat, judged.rho, judged.safe, judged.requirements, self._task.cost(judged)]
        if falls:
            rows.append(prefix_robustness(self._formulas, judged.columns).t())
        return [row.reshape(-1, count, *row.shape[1:]) for row in rows]


def _picked(values: Sequence[Tensor], pick: Tensor) -> list[Tensor]:
    """Select entry `pick` (rows,) of every row: (rows, choices, …) -> (rows, …)."""
    rows = torch.arange(pick.shape[0])  # `len` would fix the size of the batch
    return [value[rows, pick] for value in values]


def recorded_guard(task: Task, network: PlanProposer) -> ExportedProgram:
    """Return the guard of Meng and Fan 2023 as an exported torch program for any batch size.

    All floating-point inputs and outputs are float64.
    """
    x = task.sample(2, seed=0, dtype=torch.float64)
    plan = torch.zeros(2, task.horizon, len(task.system.decl.controls), dtype=torch.float64)
    return _exported(Guarding(task, network), x, plan)
