"""Closed-loop simulator: worlds advance seed by seed; decisions for all seeds are made in one batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.deployment.batched import Setting, Worlds
from stlc.diagnostics import Diagnostic, RunError

if TYPE_CHECKING:
    from stlc.controller.guard.guard import Guard, GuardDecision
    from stlc.controller.world import WorldType

__all__ = ["DeploymentRecording", "Recorder", "Setting", "SimulationStep", "Watch", "simulate"]

Frame = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class DeploymentRecording:
    """Trajectories of `agents` agents per seed; rows are ordered by seed, then by agent.

    Attributes:
        agents: number of agents per seed.
        states: (rows, steps + 1, n).
        actions: (rows, steps, m).
        source: (rows, steps), index into `stlc.controller.guard.guard.SOURCES`.
        t0: (rows, steps), prefix length of the backup policy, 0 for the policy's own plan.
        rho: (rows, steps), robustness of the followed plan.
        policy_rho: (rows, steps), robustness of the policy's own plan.
        safe: (rows, steps), whether the followed plan satisfies phi_safe.
        progress: task progress of each seed.
        units: units of the entries of `progress`.
        scene: snapshots of the first seed, stacked over time, and `decision` (frames, agents). For a world
            that maps planned states into its picture also `rejected` and `taken`, float32 (frames, agents,
            horizon + 1, 2 or 3): the policy plan that a guard replaced and the followed plan; NaN without
            intervention.
        eventless: (rows, steps), whether there was no exogenous event; None if not recorded.
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
    """Recorder of a deployment that stores every step at once, so that a failure loses no earlier step.

    `pictured`: whether the plans that a guard replaces are recorded for pictures.
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
        """Record the initial states `x` (rows, n), ordered by seed, then by agent."""
        self.states.append(x)
        self.frames.append(frame)

    def step(self, decision: GuardDecision, action: Tensor, x: Tensor, frame: Frame) -> None:
        """Record one step: `action` (rows, m), and the next states `x` (rows, n)."""
        self.decisions.append(decision)
        self.actions.append(action)
        self.start(x, frame)

    def chosen(self, x: Tensor, options: Tensor) -> None:
        """Record the states under all options, (rows, k, n), and those under the chosen ones, (rows, n)."""
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
        step: index of the step, from 0; `steps` after the last one, when nothing is decided any more.
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
    """The agents' current plans and their ages in steps."""

    def __init__(self, guard: Guard, setting: Setting) -> None:
        self.guard, self.replan = guard, setting.replan
        columns = guard.task.plain.signature.columns
        self.exogenous = [index for index, column in enumerate(columns) if column.role == "env"]
        self.decision: GuardDecision | None = None
        self.age = torch.zeros(0, dtype=torch.int64)

    def due(self, x: Tensor, seen: Tensor, step: int) -> Tensor:
        """Indices of the rows (one per agent and seed) that replan at this step, (k,).

        Every `replan` steps these are all rows; at other steps, those whose exogenous signals have changed
        and, with the full guard, those whose remaining plan violates a safety requirement by the model. A
        plan that ends before the next regular planning step is checked with its last action held. The last
        sample of a plan is not checked, because `sweep` would extrapolate from it to states that were not
        planned.
        """
        if self.decision is None or step % self.replan == 0:
            return torch.arange(len(x))
        left = (self.guard.task.horizon - 1 - self.age).clamp(min=self.replan - step % self.replan)
        danger = self.guard.endangered(seen, self.decision.later(self.age), left)
        return torch.nonzero((x != self.before)[:, self.exogenous].any(1) | danger).squeeze(1)

    def prefer(self, options: Tensor, due: Tensor) -> Tensor:
        """Index of the option that each row takes, (rows,); 0, no change, for rows that do not replan."""
        pick = torch.zeros(len(options), dtype=torch.int64)
        if len(due):
            pick[due] = self.guard.prefer(options[due], self._previous(due, options[:, 0]))
        return pick

    def decide(self, x: Tensor, seen: Tensor, due: Tensor) -> tuple[GuardDecision, Tensor]:
        """Return decisions and actions (rows, m); the rows in `due` replan from measured states `seen`."""
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
        """Remainders of the previous plans of the rows in `due`, for the measured states `seen` (rows, n).

        With `replan` > 1 the policy extends the plans at their ends: if the last action were held for that
        many steps, the previous plan might violate the specification and would never be retained.
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
        SystemFileError: S207, a world fails; S211, it cannot redraw an initial state; S302, its states are
            not finite.
        RunError: R405, no plan is known from any drawn initial state; R402, an action is not finite.
    """
    worlds, pilot = Worlds(guard.task, make, setting), _Pilot(guard, setting)
    x = worlds.reset()
    recorder.start(x, worlds.snapshot())
    recorder.units, recorder.redrawn = worlds.units(), worlds.redrawn
    for step in range(setting.steps):
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
    """Picture coordinates of the first seed's plans that a guard just replaced, and of the new ones.

    None without a guard, and if the world does not map planned states to picture coordinates.
    """
    if guard.backup is None or not worlds.charting:
        return None
    agents = worlds.size[0]
    new = due[due < agents]
    rows = new[(decision.source[new] > 0) & ~(decision.policy_rho[new] >= -TOLERANCE)]
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
    """Raise RunError (R402) where an action (rows, m) to be executed is not finite."""
    broken = torch.nonzero(~torch.isfinite(action).all(1)).squeeze(1).tolist()
    if not broken:
        return
    state = zip(guard.task.system.names, x[broken[0]].tolist(), strict=True)
    note = "its state: " + ", ".join(f"{name} = {value:.6g}" for name, value in state)
    help_ = ("`--backup` lets the backup policy act where the policy cannot",) if guard.backup is None else ()
    message = f"the policy's plan at step {step} is not a number, for {len(broken)} of {len(x)} agents"
    raise RunError(Diagnostic("R402", message, note=(note,), help=help_))
