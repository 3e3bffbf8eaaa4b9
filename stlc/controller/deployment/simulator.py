"""Closed loop: worlds advance seed by seed, decisions are taken for the agents of all seeds in one batch."""

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

__all__ = ["DeploymentRecording", "Recorder", "Setting", "SimulationStep", "Watch", "drive"]

Frame = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class DeploymentRecording:
    """Trajectories of `agents` agents of each seed; rows are those of the first seed, then of the next.

    Attributes:
        agents: of one seed.
        states: (rows, steps + 1, n).
        actions: (rows, steps, m).
        source: (rows, steps), index into `stlc.controller.guard.guard.SOURCES`.
        t0: (rows, steps), length of the backup's prefix, 0 for the policy's own plan.
        rho: (rows, steps), robustness of the plan that was followed.
        policy_rho: (rows, steps), robustness of what the policy had planned.
        safe: (rows, steps), whether the plan that was followed satisfies phi_safe.
        progress: of each seed.
        units: of entries of `progress`.
        scene: snapshots of the first seed, stacked over time, and `decision` (frames, agents). Where a world
            says where planned states are in its picture also `rejected` and `taken`, float32
            (frames, agents, horizon + 1, 2 or 3): the policy's plan that a guard replaced, and the plan that
            was followed; NaN where none was replaced.
        quiet: (rows, steps), whether the world did nothing but what the truth of the dynamics does; None
            where nobody has looked.
        options: (rows, steps, k, n), among which agents chose; None where the world leaves no choice.
        redrawn: starts that were drawn again because no plan is known from them.
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
    quiet: NDArray[np.bool_] | None = None
    redrawn: int = 0

    @property
    def steps(self) -> int:
        """Number of steps taken."""
        return int(self.actions.shape[1])


@dataclass
class Recorder:
    """Gathers a recording step by step, so that what happened before a failure is not lost.

    `pictured`: whether the plans that a guard replaces are wanted, for pictures.
    """

    agents: int
    pictured: bool = True
    states: list[Tensor] = field(default_factory=list)
    actions: list[Tensor] = field(default_factory=list)
    decisions: list[GuardDecision] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    options: list[Tensor] = field(default_factory=list)
    quiet: list[Tensor] = field(default_factory=list)
    replaced: list[Frame] = field(default_factory=list)
    progress: tuple[Mapping[str, float], ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    redrawn: int = 0

    def start(self, x: Tensor, frame: Frame) -> None:
        """The first sample: `x` (rows, n), agents of all seeds one after the other."""
        self.states.append(x)
        self.frames.append(frame)

    def step(self, decision: GuardDecision, action: Tensor, x: Tensor, frame: Frame) -> None:
        """One more step with `action` (rows, m), and the sample `x` (rows, n) behind it."""
        self.decisions.append(decision)
        self.actions.append(action)
        self.start(x, frame)

    def chosen(self, x: Tensor, options: Tensor) -> None:
        """The present sample is `x` (rows, n) by the choice of the agents among `options` (rows, k, n)."""
        self.states[-1] = x
        self.options.append(options)

    def recording(self) -> DeploymentRecording | None:
        """Recording so far, whole steps only; None before the first one."""
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
            quiet=torch.stack(self.quiet[:steps], 1).numpy(force=True) if len(self.quiet) >= steps else None,
            redrawn=self.redrawn,
        )


@dataclass(frozen=True, slots=True)
class SimulationStep:
    """A step of a deployment, as it has been decided.

    Attributes:
        step: its number, from 0; `steps` at the end, when nothing is decided any more.
        steps: of the deployment.
        x: the states, (rows, n).
        decision: what is followed; None at the end.
        planned: how many rows planned anew.
        seconds: that deciding took.
    """

    step: int
    steps: int
    x: Tensor
    decision: GuardDecision | None
    planned: int = 0
    seconds: float = 0.0


Watch = Callable[[SimulationStep], None]


class _Pilot:
    """Plans that agents follow, and their ages."""

    def __init__(self, guard: Guard, setting: Setting) -> None:
        self.guard, self.replan = guard, setting.replan
        columns = guard.task.plain.signature.columns
        self.told = [index for index, column in enumerate(columns) if column.role == "env"]
        self.decision: GuardDecision | None = None
        self.age = torch.zeros(0, dtype=torch.int64)

    def due(self, x: Tensor, seen: Tensor, step: int) -> Tensor:
        """Rows that plan now, (k,): all every `replan` steps, and those that the world told something.

        So does whom the full guard sees run into danger with what is left of its plan. Where a plan is used
        up before the others plan again, its last action counts until then. The last sample of a plan does
        not: `sweep` looks from there to where nobody has planned to go.
        """
        if self.decision is None or step % self.replan == 0:
            return torch.arange(len(x))
        left = (self.guard.task.horizon - 1 - self.age).clamp(min=self.replan - step % self.replan)
        danger = self.guard.endangered(seen, self.decision.later(self.age), left)
        return torch.nonzero((x != self.before)[:, self.told].any(1) | danger).squeeze(1)

    def prefer(self, options: Tensor, due: Tensor) -> Tensor:
        """Option of each row, (rows,); rows that do not plan now keep theirs."""
        pick = torch.zeros(len(options), dtype=torch.int64)
        if len(due):
            pick[due] = self.guard.prefer(options[due], self._begun(due, options[:, 0]))
        return pick

    def decide(self, x: Tensor, seen: Tensor, due: Tensor) -> tuple[GuardDecision, Tensor]:
        """Decisions, and actions (rows, m), where those in rows `due` plan for what they see of `x`."""
        if len(due):
            new = self.guard.decide(seen[due], self._begun(due, seen))
            whole = self.decision is None or len(due) == len(x)
            self.decision = new if self.decision is None or whole else self.decision.with_new(due, new)
            self.age = torch.zeros(len(x), dtype=torch.int64) if whole else self.age.index_fill(0, due, 0)
        assert self.decision is not None
        action = self.decision.later(self.age).action
        self.age, self.before = self.age + 1, x
        return self.decision, action

    def _begun(self, due: Tensor, seen: Tensor) -> GuardDecision | None:
        """What is left of the plans of those in rows `due`, who see `seen` (rows, n).

        Where several steps of a plan are taken before the next is made, the policy goes on from its end: the
        last action held for that long may run into a wall, and then nobody would go on with the plan.
        """
        if self.decision is None:
            return None
        left = self.decision.of(due).later(self.age[due])
        return left if self.replan == 1 else self.guard.carried_on(seen[due], left, self.age[due])


def drive(
    guard: Guard, make: WorldType, setting: Setting, recorder: Recorder, watch: Watch | None = None
) -> None:
    """Deploy in fresh worlds, one a seed, into `recorder`; `watch` is told every step.

    Raises:
        SystemFileError: S207, a world fails; S211, it cannot draw a start again; S302, it gives states that
            are no numbers.
        RunError: R405, no start with a known plan is drawn; R402, a plan that is no number would have to be
            executed.
    """
    worlds, pilot = Worlds(guard.task, make, setting), _Pilot(guard, setting)
    x = worlds.reset()
    recorder.start(x, worlds.snapshot())
    recorder.units, recorder.redrawn = worlds.units(), worlds.redrawn
    for step in range(setting.steps):
        seen = worlds.disturbance.seen(x, step)
        due = pilot.due(x, seen, step)
        options, begun = worlds.options(x), perf_counter()
        if options is not None:
            chosen = worlds.choose(pilot.prefer(options + (seen - x)[:, None], due), x)
            seen, x = seen + (chosen - x), chosen
            recorder.chosen(x, options)
        decision, action = pilot.decide(x, seen, due)
        seconds = perf_counter() - begun
        replaced = _replaced(worlds, guard, decision, seen, due) if recorder.pictured else None
        if replaced is not None:
            recorder.replaced.append(replaced)
        _require_numbers(action, x, step, guard)
        if watch is not None:
            watch(SimulationStep(step, setting.steps, x, decision, len(due), seconds))
        x = worlds.advance(x, action, step + 1)
        recorder.step(decision, action, x, worlds.snapshot())
        recorder.quiet.append(worlds.quiet)
        recorder.progress = worlds.progress()
    if watch is not None:
        watch(SimulationStep(setting.steps, setting.steps, x, None))


def _replaced(
    worlds: Worlds, guard: Guard, decision: GuardDecision, seen: Tensor, due: Tensor
) -> dict[str, NDArray[np.float32]] | None:
    """Places along plans of the first seed that a guard has just replaced, and along those in their place.

    None without a guard, and where the world does not say where planned states are in its picture.
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
            foreseen = guard.task.rollout(seen[rows], plans[rows].to(torch.float64))
            states[rows] = foreseen[..., : worlds.size[1]].to(states)
        found[name] = worlds.charted(states).astype(np.float32)
    return found


def _require_numbers(action: Tensor, x: Tensor, step: int, guard: Guard) -> None:
    """Raise RunError (R402) where an action (rows, m) that is about to be taken is no number."""
    broken = torch.nonzero(~torch.isfinite(action).all(1)).squeeze(1).tolist()
    if not broken:
        return
    state = zip(guard.task.names, x[broken[0]].tolist(), strict=True)
    note = "its state: " + ", ".join(f"{name} = {value:.6g}" for name, value in state)
    help_ = ("`--backup` lets the backup policy act where the policy cannot",) if guard.backup is None else ()
    message = f"the policy's plan at step {step} is not a number, for {len(broken)} of {len(x)} agents"
    raise RunError(Diagnostic("R402", message, note=(note,), help=help_))
