"""Closed-loop simulator: one world per seed; all agents of all seeds decide in one batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting, Worlds
from stlc.diagnostics import RunError

if TYPE_CHECKING:
    from stlc.controller.guard.guard import Guard, GuardDecision
    from stlc.controller.world import WorldType


Frame = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class DeploymentRecording:
    """Recorded deployment. A row is one agent of one seed; rows are ordered by seed, then by agent.

    Attributes:
        agents: number of agents per seed.
        states: true states, (rows, steps + 1, n).
        actions: executed actions of the followed plans, (rows, steps, m).
        source: (rows, steps), source of the followed plan, an index into
            `stlc.controller.guard.candidates.SOURCES`.
        t0: (rows, steps), prefix length of the followed plan: number of its first actions that the backup
            policy chose from a few fixed control values (a grid); 0 if there are none, as in the policy's
            own plan.
        rho: (rows, steps), robustness of the followed plan.
        policy_rho: (rows, steps), robustness of the policy's own plan.
        safe: (rows, steps), whether the followed plan satisfies the requirements tagged `@safety`.
        progress: task progress of each seed.
        units: units of the entries of `progress`.
        scene: arrays for pictures of the first seed: the snapshots of its world, stacked over time, and
            `decision`, the source of each agent's plan, (frames, agents). If the world maps planned states to
            picture coordinates, there are two more arrays: `rejected`, the policy's plans that a guard
            replaced, and `taken`, the plans followed instead. Both are float32, (frames, agents, horizon + 1,
            2 or 3), and NaN where no plan was replaced.
        eventless: (rows, steps), True where no exogenous event occurred; None if this was not recorded.
        options: (rows, steps, k, n), states under the options (alternatives that a world offers to its
            agents); None if there are none.
        redrawn: number of initial states that were drawn again because no plan is known from them.
    """

    agents: int
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    source: NDArray[np.int64]
    t0: NDArray[np.int64]
    rho: NDArray[np.float64]
    policy_rho: NDArray[np.float64]
    safe: NDArray[np.bool_]
    progress: tuple[Mapping[str, float], ...]
    units: Mapping[str, str]
    scene: Mapping[str, NDArray[Any]]
    options: NDArray[np.float64] | None = None
    eventless: NDArray[np.bool_] | None = None
    redrawn: int = 0

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return int(self.actions.shape[1])


@dataclass
class Recorder:
    """Recorder of a deployment. It stores each step when it happens: a failure loses no earlier step.

    `agents`: number of agents per seed. `pictured`: whether the plans that a guard replaces are recorded too,
    so that pictures can show them.
    """

    agents: int
    pictured: bool = True
    states: list[Tensor] = field(default_factory=list)
    actions: list[Tensor] = field(default_factory=list)
    decisions: list[GuardDecision] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    options: list[Tensor] = field(default_factory=list)
    eventless: list[Tensor] = field(default_factory=list)
    replaced: list[Frame] = field(default_factory=list)
    progress: tuple[Mapping[str, float], ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    redrawn: int = 0

    def start(self, x: Tensor, frame: Frame) -> None:
        """Record the initial states `x`, (rows, n), which are ordered by seed, then by agent.

        `frame`: the arrays from which the first picture is drawn, name -> array.
        """
        self.states.append(x)
        self.frames.append(frame)

    def step(self, decision: GuardDecision, action: Tensor, x: Tensor, frame: Frame) -> None:
        """Record one step: `decision`, executed actions (rows, m), and next states `x` (rows, n).

        `frame`: the arrays from which the picture after the step is drawn, name -> array.
        """
        self.decisions.append(decision)
        self.actions.append(action)
        self.start(x, frame)

    def chosen(self, x: Tensor, options: Tensor) -> None:
        """Record a choice among options (alternatives that a world offers to its agents).

        Args:
            x: states under the chosen options, (rows, n); they replace the latest recorded states.
            options: states under all options, (rows, k, n).
        """
        self.states[-1] = x
        self.options.append(options)

    def recording(self) -> DeploymentRecording | None:
        """Return the recording of all complete steps; None before the first one is complete."""
        steps = min(len(self.actions), len(self.frames) - 1)
        if steps < 1:
            return None
        decisions, frames = self.decisions[:steps], self.frames[: steps + 1]
        columns = {
            name: torch.stack([getattr(decision, name) for decision in decisions], 1).numpy(force=True)
            for name in ("source", "t0", "rho", "policy_rho", "safe")
        }
        scene = {name: np.stack([frame[name] for frame in frames]) for name in frames[0]}
        decided = columns["source"][: self.agents].T
        scene["decision"] = np.concatenate((decided, decided[-1:])).astype(np.int8)
        for name in self.replaced[0] if len(self.replaced) >= steps else ():
            plans = np.stack([frame[name] for frame in self.replaced[:steps]])
            scene[name] = np.concatenate((plans, np.full_like(plans[:1], np.nan)))
        return DeploymentRecording(
            self.agents,
            torch.stack(self.states[: steps + 1], 1).numpy(force=True),
            torch.stack(self.actions[:steps], 1).numpy(force=True),
            **columns,
            progress=self.progress,
            units=self.units,
            scene=scene,
            options=torch.stack(self.options[:steps], 1).numpy(force=True) if self.options else None,
            eventless=torch.stack(self.eventless[:steps], 1).numpy(force=True)
            if len(self.eventless) >= steps
            else None,
            redrawn=self.redrawn,
        )


@dataclass(frozen=True, slots=True)
class SimulationStep:
    """One step of a deployment, after the decision and before the worlds advance.

    Attributes:
        step: index of the step, from 0. After the last step, when nothing is decided, it equals `steps`.
        steps: total number of steps.
        x: states, (rows, n).
        decision: the guard's decision; None after the last step.
        planned: number of rows that replanned.
        seconds: time that the decision took.
    """

    step: int
    steps: int
    x: Tensor
    decision: GuardDecision | None
    planned: int = 0
    seconds: float = 0.0


Watch = Callable[[SimulationStep], None]


class _Pilot:
    """Decision logic of a simulation: the rows that replan at a step, their plans, and the plans' ages.

    A row is one agent of one seed. The age of a plan is the number of its actions already executed.
    """

    def __init__(self, guard: Guard, setting: Setting) -> None:
        self.guard, self.replan = guard, setting.replan
        columns = guard.task.plain.signature.columns
        self.exogenous = [index for index, column in enumerate(columns) if column.role == "env"]
        self.decision: GuardDecision | None = None
        self.age = torch.zeros(0, dtype=torch.int64)

    def due(self, x: Tensor, seen: Tensor, step: int) -> Tensor:
        """Indices of the rows (one per agent and seed) that replan at this step, (k,).

        All rows replan every `replan` steps. At other steps a row replans for one of two reasons:

        - An exogenous signal has changed in its true state `x`.
        - The rest of its plan is predicted to violate a safety requirement. Guards that monitor plans predict
          this, from the measured state `seen`.

        If a plan ends before the next regular replanning, the prediction repeats the plan's last action. The
        last sample of a plan is not checked, because a `sweep` predicate judges the motion between two
        samples, and no sample follows the last one.
        """
        if self.decision is None or step % self.replan == 0:
            return torch.arange(len(x))
        left = (self.guard.task.horizon - 1 - self.age).clamp(min=self.replan - step % self.replan)
        danger = self.guard.endangered(seen, self.decision.later(self.age), left)
        return torch.nonzero((x != self.before)[:, self.exogenous].any(1) | danger).squeeze(1)

    def prefer(self, options: Tensor, due: Tensor) -> Tensor:
        """Index of the option (alternative offered by the world) that each row takes, (rows,).

        Rows that do not replan get option 0, which changes nothing.

        Args:
            options: states under each option, (rows, k, n).
            due: indices of the rows that replan, (d,).
        """
        pick = torch.zeros(len(options), dtype=torch.int64)
        if len(due):
            pick[due] = self.guard.prefer(options[due], self._previous(due, options[:, 0]))
        return pick

    def decide(self, x: Tensor, seen: Tensor, due: Tensor) -> tuple[GuardDecision, Tensor]:
        """Let the rows `due` replan from the measured states `seen`; return decision and actions (rows, m).

        The other rows continue their plans. `x`: true states, (rows, n).
        """
        if len(due):
            new = self.guard.decide(seen[due], self._previous(due, seen))
            whole = self.decision is None or len(due) == len(x)
            self.decision = new if self.decision is None or whole else self.decision.with_new(due, new)
            self.age = torch.zeros(len(x), dtype=torch.int64) if whole else self.age.index_fill(0, due, 0)
        assert self.decision is not None
        action = self.decision.later(self.age).action
        self.age, self.before = self.age + 1, x
        return self.decision, action

    def _previous(self, due: Tensor, seen: Tensor) -> GuardDecision | None:
        """Remainders of the previous plans of the rows in `due`; None at the first step.

        The actions already executed are removed from a plan. If `replan` > 1, the policy appends new actions,
        so that the plan has T actions again. To do so, it needs the measured states `seen`, (rows, n). A
        repetition of the last action instead might violate the specification, and the guard would hardly ever
        retain a previous plan.
        """
        if self.decision is None:
            return None
        left = self.decision.of(due).later(self.age[due])
        return left if self.replan == 1 else self.guard.extended(seen[due], left, self.age[due])


def simulate(
    guard: Guard, make: WorldType, setting: Setting, recorder: Recorder, watch: Watch | None = None
) -> None:
    """Simulate new worlds, one per seed, and record them in `recorder`; `watch` is called at every step.

    Raises:
        SystemFileError: S207, a method of a world raises an exception or returns a wrong type or shape; S211,
            a world cannot redraw an initial state; S302, its states are not finite.
        RunError: R405, an agent gets no initial state from which a plan is known; R402, an action is not
            finite.
    """
    worlds, pilot = Worlds(guard.task, make, setting), _Pilot(guard, setting)
    x = worlds.reset()
    recorder.start(x, worlds.snapshot())
    recorder.units, recorder.redrawn = worlds.units(), worlds.redrawn
    for step in range(setting.steps):
        with worlds.drawing():
            seen = worlds.disturbance.seen(x, step)
        due = pilot.due(x, seen, step)
        options, began = worlds.options(x), perf_counter()
        if options is not None:
            chosen = worlds.choose(pilot.prefer(options + (seen - x)[:, None], due), x)
            seen, x = seen + (chosen - x), chosen
            recorder.chosen(x, options)
        decision, action = pilot.decide(x, seen, due)
        seconds = perf_counter() - began
        replaced = _replaced(worlds, guard, decision, seen, due) if recorder.pictured else None
        if replaced is not None:
            recorder.replaced.append(replaced)
        _require_numbers(action, x, step, guard)
        if watch is not None:
            watch(SimulationStep(step, setting.steps, x, decision, len(due), seconds))
        x = worlds.advance(x, action, step + 1)
        recorder.step(decision, action, x, worlds.snapshot())
        recorder.eventless.append(worlds.eventless)
        recorder.progress = worlds.progress()
    if watch is not None:
        watch(SimulationStep(setting.steps, setting.steps, x, None))


def _replaced(
    worlds: Worlds, guard: Guard, decision: GuardDecision, seen: Tensor, due: Tensor
) -> dict[str, NDArray[np.float32]] | None:
    """Picture coordinates of the first seed's plans that the guard replaced at this step.

    Returns:
        `rejected`: the policy's plans, and `taken`: the plans followed instead, (agents, T + 1, 2 or 3) each;
        NaN for agents whose plan was not replaced. None if there is no guard, or if the world cannot map
        planned states to picture coordinates.
    """
    if guard.backup is None or not worlds.charting:
        return None
    agents = worlds.size[0]
    new = due[due < agents]
    rows = new[(decision.source[new] > 0) & ~TOLERANCE.satisfied(decision.policy_rho[new])]
    found = {}
    for name, plans in (("rejected", decision.proposed), ("taken", decision.plan)):
        steps = guard.task.horizon + 1
        states = torch.full((agents, steps, worlds.size[1]), torch.nan, dtype=torch.float64)
        if len(rows):
            predicted = guard.task.rollout(seen[rows], plans[rows].to(torch.float64))
            states[rows] = predicted[..., : worlds.size[1]].to(states)
        found[name] = worlds.charted(states).astype(np.float32)
    return found


def _require_numbers(action: Tensor, x: Tensor, step: int, guard: Guard) -> None:
    """Check that the actions to be executed, (rows, m), are finite.

    Raises:
        RunError: R402, an action is not finite. The message contains the state of the first row with such an
            action.
    """
    broken = torch.nonzero(~torch.isfinite(action).all(1)).squeeze(1).tolist()
    if not broken:
        return
    state = zip(guard.task.system.names, x[broken[0]].tolist(), strict=True)
    note = "its state: " + ", ".join(f"{name} = {value:.6g}" for name, value in state)
    help_ = ("`--backup` lets the backup policy act where the policy cannot",) if guard.backup is None else ()
    message = f"the policy's plan at step {step} is not a number, for {len(broken)} of {len(x)} agents"
    raise RunError.of("R402", message, note=(note,), help=help_)
