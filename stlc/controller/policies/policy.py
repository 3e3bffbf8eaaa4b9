"""Policies: map states to candidate plans, and select one of them by exact verdicts.

A continuous function cannot jump from a path left of an obstacle to one right of it; a set of several plans
can, and judging a few plans exactly costs well under a millisecond. For the same reason, slightly changed
copies of a plan that just fails are judged, too (docs/decisions/0049-variations.md). Planners propose a
single plan, and so do policies that are made from an actor (state -> action).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, Self

import torch
from torch import Tensor, nn

from stlc.controller.problem.environments import observe
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.dynamics.declaration.schema.names import ControlDecl
from stlc.dynamics.model.controls import raw_width, squash, unsquash
from stlc.dynamics.model.mirror import Mirror

VARIATIONS = (0.01, 0.05)
"""Sizes of the changes in `variations`, as shares of half the range of a control."""
MOST_STEPS = 1_000_000
"""Maximum number of steps of changed plans that are judged at a time, which bounds the memory."""


def variations(task: Task) -> Tensor:
    """Small changes to be added to plans, in physical units: (V, T, m), float64.

    Each changes a single control. The change is the same at every step, or falls like half a cosine from an
    amount at the first step to its negative at the last step. Each of the m controls has V / m = 8 changes:
    these two shapes, with two sizes (`VARIATIONS`) and both signs.
    """
    steps, controls = task.horizon, task.system.control_low.shape[0]
    half = 0.5 * (task.system.control_high - task.system.control_low).to("cpu", torch.float64)
    time = torch.arange(steps, dtype=torch.float64)
    shapes = torch.stack((torch.ones_like(time), torch.cos(math.pi * (time + 0.5) / steps)))
    sizes = torch.tensor([sign * size for size in VARIATIONS for sign in (1.0, -1.0)], dtype=torch.float64)
    amount = sizes[:, None, None, None] * torch.diag(half)[None, :, None, :]  # (sizes, changed control, 1, m)
    found = amount[:, :, None] * shapes[None, None, :, :, None]
    return found.reshape(-1, steps, controls)


class Policy(ABC):
    """Interface of planners and trained policies: candidate plans, and the selection among them.

    Of the candidate plans that satisfy the specification, the one with the least performance cost is
    selected. If no candidate satisfies it, the one with the largest exact robustness is selected.

    Attributes:
        task: task whose verdicts select the plan; `for_task` returns the policy for another task.
        network: network that proposes the plans. A policy without network (None) cannot be exported.
    """

    network: PlanProposer | None = None
    judged_at_once: int = 500

    def __init__(self, task: Task) -> None:
        self.task = task

    @abstractmethod
    def candidates(self, x0: Tensor) -> Tensor:
        """All candidate plans in physical units: (B, n) -> (B, plans, T, m)."""

    def for_task(self, task: Task) -> Self:
        """Copy of this policy that selects plans by the verdicts of `task`, another task of the same system.

        Example: a task whose requirements must be satisfied with robustness margins.
        """
        other = copy(self)
        other.task = task
        return other

    @torch.no_grad()
    def plan(self, x0: Tensor) -> Tensor:
        """The selected plan from each state, in physical units: (B, n) -> (B, T, m) in the dtype of `x0`."""
        plans = self.candidates(x0).to(x0.dtype)
        return plans[:, 0] if plans.shape[1] == 1 else self._best(x0, plans)[0]

    def continuation(self, x0: Tensor) -> Tensor:
        """Plans that continue prefixes (first actions of plans): (B, n) -> (B, T, m).

        `x0`: the states that the prefixes reach. Since these may be many, a policy whose method `plan` is
        slow returns plans here that are faster to compute. By default the plans are those of `plan`.
        """
        return self.plan(x0)

    def __call__(self, x0: Tensor) -> Tensor:
        """The selected plan, as `plan` returns it."""
        return self.plan(x0)

    @torch.no_grad()
    def plan_judged(
        self,
        x0: Tensor,
        rest: Tensor | None = None,  # noqa: ARG002
    ) -> tuple[Tensor, PlanVerdicts]:
        """The selected plan from each state, as `plan` returns it, and the verdicts on these plans.

        `rest`: remainders of the plans that are followed, (B, T, m), where a planner may begin.
        """
        return self._best(x0, self.candidates(x0).to(x0.dtype))

    def _best(self, x0: Tensor, plans: Tensor) -> tuple[Tensor, PlanVerdicts]:
        """Select the best of the plans from each state.

        `plans`: candidate plans, (B, plans, T, m).

        Returns:
            The selected plans, (B, T, m), and the verdicts on them.
        """
        batch, count = plans.shape[:2]
        if count == 1:
            return plans[:, 0], self.task.judge(x0, plans[:, 0])
        judged = self.task.judge(x0.repeat_interleave(count, 0), plans.flatten(0, 1))
        rows = torch.arange(batch, device=x0.device)
        best = self.task.rank(judged).view(batch, count).argmax(1)
        return plans[rows, best], judged.of(rows * count + best)


class ModelRollout(Policy):
    """Policy made from an actor, a function that chooses one action per step.

    The plan consists of the actions that the actor chooses in closed loop on the model of the system.

    Args:
        actor: function from states (B, n), which include timers, to actions (B, m) in physical units.
        task: specification and system.
    """

    def __init__(self, actor: Callable[[Tensor], Tensor], task: Task) -> None:
        super().__init__(task)
        self.actor = actor

    def candidates(self, x0: Tensor) -> Tensor:
        """One plan per state: (B, n) -> (B, 1, T, m)."""
        x, actions = x0, []
        for _ in range(self.task.horizon):
            actions.append(self.actor(x))
            x = self.task.system.step(x, actions[-1])
        return torch.stack(actions, 1)[:, None]


@dataclass(frozen=True, slots=True)
class DenseLayers:
    """Weights of a feed-forward network (MLP), in the form in which exports write it.

    Attributes:
        centre: mean of the inputs, (k,), which is subtracted first.
        spread: standard deviation of the inputs, (k,), by which they are divided.
        bound: bound on the absolute value of the normalised inputs; infinite if there is none.
        weights: weights of each layer, (outputs, inputs).
        biases: biases of each layer, (outputs,).
        activation: function between the layers.
    """

    centre: Tensor
    spread: Tensor
    bound: float
    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    activation: Literal["relu", "tanh"]

    @classmethod
    def of(
        cls,
        layers: Sequence[nn.Module],
        *,
        normalisation: tuple[Tensor, Tensor],
        activation: Literal["relu", "tanh"],
        bound: float = math.inf,
    ) -> DenseLayers:
        """Return the weights of the linear modules among `layers`, in order.

        `normalisation` holds `centre` and `spread`.
        """
        linear = [each for each in layers if isinstance(each, nn.Linear)]
        weights, biases = tuple(each.weight for each in linear), tuple(each.bias for each in linear)
        return cls(*normalisation, bound, weights, biases, activation)


class PlanProposer(nn.Module, ABC):
    """Network that proposes plans: the part of a policy that is trained, and that exports write.

    Attributes:
        plans: number of plans per state.
        changes: changes that `BestOfKPolicy` adds to a plan that fails, (V, T, m) float64; V may be 0.
        mirror: mirror symmetry of the system; None if the system has none or the network does not use it.
        clock: index of the state that counts the steps of a mission, negative, as the timers come last in
            states and observations; None if the plans do not reach to its end.
    """

    plans: int
    changes: Tensor
    mirror: Mirror | None = None
    clock: int | None = None

    def __init__(self, task: Task) -> None:
        super().__init__()
        self._task = task

    @property
    @abstractmethod
    def layers(self) -> DenseLayers:
        """Weights of the feed-forward network."""

    @property
    def outputs(self) -> tuple[ControlDecl, ...]:
        """Controls as the network's outputs stand for them: `squash` of each maps outputs to its range."""
        return self._task.system.decl.controls

    @abstractmethod
    def forward(self, x0: Tensor) -> Tensor:
        """All plans, within the control bounds: (B, n) -> (B, plans, T, m)."""

    def with_changes(self, plans: Tensor) -> Tensor:
        """Each plan and its changed copies, within the control bounds: (k, T, m) -> (k, 1 + V, T, m)."""
        system = self._task.system
        low, high = system.control_low.to(plans), system.control_high.to(plans)
        changed = plans[:, None] + self.changes.to(plans)
        return torch.cat((plans[:, None], changed.clamp(low, high)), 1)


FAINT = 0.1
"""Factor of the last layer's weights in a network that begins at given plans."""


class PlanNetwork(PlanProposer):
    """MLP from the observation to `plans` open-loop plans over the horizon.

    If plans reach to the end of a mission, its outputs are a plan for the whole mission, and what is left of
    it at the state's clock is proposed. So a plan that is followed stays what the network proposes.

    If the system declares a mirror symmetry, states on one side of it are mirrored before the network is
    evaluated, and their plans are mirrored back.

    Attributes:
        centre: mean of the observations, (k,), by which the network's inputs are centred.
        spread: standard deviation of the observations, (k,), by which the network's inputs are divided.
    """

    centre: Tensor
    spread: Tensor

    def __init__(
        self,
        task: Task,
        *,
        hidden: Sequence[int],
        plans: int,
        mirrored: bool = True,
        varied: bool = False,
    ) -> None:
        super().__init__(task)
        self.plans = plans
        self.mirror = task.system.mirror if mirrored else None
        self._width = raw_width(task.system.decl.controls)
        widths = [task.system.observed_count, *hidden]
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(widths):
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
        layers.append(nn.Linear(widths[-1], plans * task.horizon * self._width))
        self.body = nn.Sequential(*layers)
        self.clock = None if task.compiled.grid.end is None else task.clock
        self.register_buffer("centre", torch.zeros(widths[0]))
        self.register_buffer("spread", torch.ones(widths[0]))
        changes = variations(task) if varied else variations(task)[:0].clone()
        self.register_buffer("changes", changes, persistent=False)

    def normalise(self, x0: Tensor) -> None:
        """Set `centre` and `spread` to mean and standard deviation of the observations of states (n, dim).

        For timers, both are computed from the range of the timer instead. Early in the training, missions end
        soon, so the states `x0` contain no late times.
        """
        observed = self._task.system.observe(self._folded(x0)[0])
        centre, spread = observed.mean(0), observed.std(0)
        for index, timer in enumerate(reversed(self._task.compiled.timers), start=1):
            centre[-index] = 0.5 * (timer.low + timer.high)
            spread[-index] = 0.25 * (timer.high - timer.low)
        self.centre.copy_(centre)
        self.spread.copy_(torch.where(spread > 1e-6, spread, torch.ones_like(spread)))

    @property
    def layers(self) -> DenseLayers:
        """Weights of the feed-forward network."""
        return DenseLayers.of(list(self.body), normalisation=(self.centre, self.spread), activation="relu")

    @torch.no_grad()
    def begin_at(self, plans: Tensor) -> None:
        """Set the weights so that `plans`, (plans, T, m), are nearly what is proposed from any state."""
        last = self.body[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(FAINT)
        last.bias.copy_(unsquash(plans, self._task.system.decl.controls).flatten())

    def forward(self, x0: Tensor) -> Tensor:
        """All plans, within the control bounds: (B, n) -> (B, plans, T, m)."""
        x0, swapped = self._folded(x0)
        observed = self._task.system.observe(x0).to(self.centre.dtype)
        raw = self.body((observed - self.centre) / self.spread)
        steps = self._task.horizon
        raw = raw.view(-1, self.plans, steps, self._width)
        plans = squash(raw, self._task.system.decl.controls)
        if self.clock is not None:
            begun = x0[:, self.clock].round().long()[:, None] + torch.arange(steps, device=x0.device)
            index = begun.clamp(0, steps - 1)[:, None, :, None].expand_as(plans)
            plans = plans.gather(2, index)
        if self.mirror is None or swapped is None:
            return plans
        return torch.where(swapped[:, None, None, None], self.mirror.plans(plans), plans)

    def _folded(self, x0: Tensor) -> tuple[Tensor, Tensor | None]:
        """Replace states on one side of the mirror symmetry by their mirror images on the other side.

        `x0`: states, (B, n).

        Returns:
            The states after the replacement, (B, n); and a mask of the replaced states, (B,). If `mirror` is
            None, all states are returned unchanged, and the mask is None.
        """
        return (x0, None) if self.mirror is None else self.mirror.fold(x0)


class ActorNetwork(nn.Module, ABC):
    """Network that chooses one action per step, from the observation and the elapsed share of the plan.

    Attributes:
        squash: map from outputs of the network to control ranges, if it is not that of the system file.
    """

    squash: Literal["tanh"] | None = None

    @property
    @abstractmethod
    def layers(self) -> DenseLayers:
        """Weights of the feed-forward network."""

    def outputs(self, task: Task) -> tuple[ControlDecl, ...]:
        """Controls of a task as the network's outputs stand for them."""
        controls = task.system.decl.controls
        return controls if self.squash is None else tuple(replace(each, squash="tanh") for each in controls)

    @abstractmethod
    def forward(self, observation: Tensor) -> Tensor:
        """Controls in physical units, without exploration noise: (B, k) float32 -> (B, m)."""


class ClosedLoopActor(PlanProposer):
    """Actor in closed loop on the model of the system: the sequence of its controls is its only plan."""

    plans = 1

    def __init__(self, task: Task, actor: ActorNetwork) -> None:
        super().__init__(task)
        self.actor = actor
        self.register_buffer("changes", variations(task)[:0].clone(), persistent=False)

    @property
    def layers(self) -> DenseLayers:
        """Weights of the actor."""
        return self.actor.layers

    @property
    def outputs(self) -> tuple[ControlDecl, ...]:
        """Controls as the actor's outputs stand for them."""
        return self.actor.outputs(self._task)

    def forward(self, x0: Tensor) -> Tensor:
        """The plan of each state: (B, n) -> (B, 1, T, m) in the dtype of `x0`."""
        x, actions = x0, []
        for step in range(self._task.horizon):
            actions.append(self.act(observe(self._task, x, step).float()).to(x))
            x = self._task.system.step(x, actions[-1])
        return torch.stack(actions, 1)[:, None]

    def act(self, observation: Tensor) -> Tensor:
        """Controls for observations, limited to their ranges: (B, k) float32 -> (B, m) float64."""
        system, action = self._task.system, self.actor(observation).double()
        return torch.clamp(action, system.control_low.to(action), system.control_high.to(action))


class BestOfKPolicy(Policy):
    """Trained policy: a network proposes several plans, and their exact robustness selects the best.

    If no proposed plan satisfies the specification, the changes in `PlanNetwork.changes` are added to the
    best of them, each by itself, and the best of the plan and its changed copies is selected.
    """

    network: PlanNetwork

    def __init__(self, task: Task, network: PlanNetwork) -> None:
        super().__init__(task)
        self.network = network

    def candidates(self, x0: Tensor) -> Tensor:
        """All plans of the network: (B, n) -> (B, plans, T, m)."""
        plans: Tensor = self.network(x0)
        return plans

    @torch.no_grad()
    def plan(self, x0: Tensor) -> Tensor:
        return self.plan_judged(x0)[0] if len(self.network.changes) else super().plan(x0)

    def continuation(self, x0: Tensor) -> Tensor:
        """The best of the network's own plans, without changes: (B, n) -> (B, T, m)."""
        return super().plan(x0)

    @torch.no_grad()
    def plan_judged(self, x0: Tensor, rest: Tensor | None = None) -> tuple[Tensor, PlanVerdicts]:
        plans, judged = super().plan_judged(x0, rest)
        failing = (~judged.satisfied).nonzero()[:, 0]
        if not len(self.network.changes) or not len(failing):
            return plans, judged
        size = max(1, MOST_STEPS // (plans.shape[1] * (1 + len(self.network.changes))))
        for rows in torch.split(failing, size):
            better, found = self._best(x0[rows], self.network.with_changes(plans[rows]))
            plans, judged = plans.index_copy(0, rows, better), judged.put(rows, found)
        return plans, judged
