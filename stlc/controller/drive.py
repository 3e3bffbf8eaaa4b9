"""Closed loop: worlds advance seed by seed, decisions are taken for the agents of all seeds in one batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.controller.disturbance import Disturbance
from stlc.controller.world import Choosing
from stlc.diagnostics import Diagnostic, RunError, StlcError, SystemFileError

if TYPE_CHECKING:
    from stlc.controller.deploy import Decision, Guard
    from stlc.controller.task import Task
    from stlc.controller.world import World, WorldType

Tick = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Recording:
    """What happened to `agents` agents of each seed; rows are the agents of the first seed, then of the next.

    Attributes:
        agents: of one seed.
        states: (rows, steps + 1, n).
        actions: (rows, steps, m).
        source: (rows, steps), index into `stlc.controller.deploy.SOURCES`.
        t0: (rows, steps), length of the backup's prefix, 0 for the policy's own plan.
        rho: (rows, steps), robustness of the plan that was followed.
        policy_rho: (rows, steps), robustness of what the policy had planned.
        safe: (rows, steps), whether the plan that was followed satisfies phi_safe.
        progress: of each seed.
        units: of entries of `progress`.
        scene: snapshots of the first seed, stacked over time, and `decision` (frames, agents).
        options: (rows, steps, k, n), among which agents chose; None where the world leaves no choice.
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

    @property
    def steps(self) -> int:
        """How many steps were taken."""
        return int(self.actions.shape[1])


@dataclass
class Recorder:
    """Gathers a recording step by step, so that what happened before a failure is not lost."""

    agents: int
    states: list[Tensor] = field(default_factory=list)
    actions: list[Tensor] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    frames: list[Mapping[str, NDArray[Any]]] = field(default_factory=list)
    options: list[Tensor] = field(default_factory=list)
    progress: tuple[Mapping[str, float], ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    def start(self, x: Tensor, world: World) -> None:
        """The first sample: `x` (rows, n), agents of all seeds one after the other."""
        self.states.append(x)
        self.frames.append(world.snapshot())

    def step(self, decision: Decision, action: Tensor, x: Tensor, world: World) -> None:
        """One more step with `action` (rows, m), and the sample `x` (rows, n) behind it."""
        self.decisions.append(decision)
        self.actions.append(action)
        self.start(x, world)

    def chosen(self, x: Tensor, options: Tensor) -> None:
        """The present sample is `x` (rows, n) by the choice of the agents among `options` (rows, k, n)."""
        self.states[-1] = x
        self.options.append(options)

    def recording(self) -> Recording | None:
        """What there is so far; None before the first step."""
        if not self.actions:
            return None
        columns = {
            name: torch.stack([getattr(decision, name) for decision in self.decisions], 1).numpy(force=True)
            for name in ("source", "t0", "rho", "policy_rho", "safe")
        }
        scene = {name: np.stack([frame[name] for frame in self.frames]) for name in self.frames[0]}
        decided = columns["source"][: self.agents].T
        scene["decision"] = np.concatenate((decided, decided[-1:])).astype(np.int8)
        return Recording(
            self.agents,
            torch.stack(self.states, 1).numpy(force=True),
            torch.stack(self.actions, 1).numpy(force=True),
            **columns,
            progress=self.progress,
            units=self.units,
            scene=scene,
            options=torch.stack(self.options, 1).numpy(force=True) if self.options else None,
        )


@dataclass(frozen=True, slots=True)
class Setting:
    """A deployment: which seeds, how many agents each, how long, and how often they plan anew.

    An agent that the world tells something new (a signal of role `env` has changed) plans at once.

    `limit`: seconds that a decision of the full guard may take per agent; None: as long as it takes.
    """

    seeds: tuple[int, ...]
    agents: int
    steps: int
    replan: int = 1
    limit: float | None = 0.1


class Worlds:
    """The worlds of all seeds, as one."""

    def __init__(self, task: Task, make: WorldType, setting: Setting) -> None:
        self.system = task.system
        self.size = (len(setting.seeds) * setting.agents, len(task.plain.names))
        self.parts = [setting.agents] * len(setting.seeds)
        with _blame("be made"):
            self.generators = [torch.Generator().manual_seed(seed) for seed in setting.seeds]
            real = task.plain.truth
            self.worlds = [make(real, setting.agents, generator) for generator in self.generators]
        self.disturbance = Disturbance(task.plain, self.generators, setting.agents)

    def reset(self) -> Tensor:
        """The first states, (rows, n); parameters are drawn, timers as at the start of a mission."""
        with _blame("begin"):
            states = [world.reset() for world in self.worlds]
        parts = zip(torch.split(self._checked(states, 0), self.parts), self.generators, strict=True)
        return torch.cat([self.system.begun(x, generator) for x, generator in parts])

    def advance(self, x: Tensor, action: Tensor, step: int) -> Tensor:
        """(rows, n), (rows, m) -> the (rows, n) states after step number `step`.

        Worlds know neither parameters nor timers: those stay, these follow from the true states.
        """
        known = x[:, : self.size[1]]
        each = zip(self.worlds, torch.split(known, self.parts), torch.split(action, self.parts), strict=True)
        with _blame(f"take step {step}"):
            states = [world.advance(before, act) for world, before, act in each]
        moved = self.disturbance.pushed(self._checked(states, step), known, step)
        return torch.cat((moved, self.system.added_later(x)), 1)

    def options(self, x: Tensor) -> Tensor | None:
        """States under every choice that there is, (rows, k, n); None where the worlds leave none."""
        choosing = [world for world in self.worlds if isinstance(world, Choosing)]
        if not choosing:
            return None
        with _blame("give options"):
            options = torch.cat([world.options() for world in choosing]).to(torch.float64)
        later = x[:, None, self.size[1] :].expand(-1, options.shape[1], -1)
        return torch.cat((options, later), 2)

    def choose(self, pick: Tensor, x: Tensor) -> Tensor:
        """The (rows, n) states when every agent has taken an option, (rows,)."""
        each = zip(self.worlds, torch.split(pick, self.parts), strict=True)
        with _blame("take a choice"):
            states = [world.choose(part) for world, part in each if isinstance(world, Choosing)]
        return torch.cat((self._checked(states, 0), x[:, self.size[1] :]), 1)

    def _checked(self, states: list[Tensor], step: int) -> Tensor:
        with _blame(f"give states at step {step}"):
            x = torch.cat(states).to(torch.float64)
        if x.shape != self.size:
            message = f"the world gives states of shape {tuple(x.shape)}, not {self.size}"
            raise SystemFileError(Diagnostic("S207", message))
        if not bool(torch.isfinite(x).all()):
            raise SystemFileError(Diagnostic("S302", f"the world gives NaN or infinity at step {step}"))
        return x


@contextmanager
def _blame(what: str) -> Iterator[None]:
    """Whatever a world raises becomes S207."""
    try:
        yield
    except StlcError:
        raise
    except Exception as error:
        note = f"{type(error).__name__}: {error}"
        raise SystemFileError(
            Diagnostic("S207", f"the world cannot {what}: {error}", note=(note,))
        ) from error


class _Pilot:
    """Who follows which plan, and since when."""

    def __init__(self, guard: Guard, setting: Setting) -> None:
        self.guard, self.replan = guard, setting.replan
        columns = guard.task.plain.signature.columns
        self.told = [index for index, column in enumerate(columns) if column.role == "env"]
        self.decision: Decision | None = None
        self.age = torch.zeros(0, dtype=torch.int64)

    def due(self, x: Tensor, step: int) -> Tensor:
        """Who plans now, (k,) rows: everybody every `replan` steps, and whom the world told something."""
        if self.decision is None or step % self.replan == 0:
            return torch.arange(len(x))
        return torch.nonzero((x != self.before)[:, self.told].any(1)).squeeze(1)

    def prefer(self, options: Tensor, due: Tensor) -> Tensor:
        """Which option everybody takes, (rows,); those who do not plan now stay with theirs."""
        pick = torch.zeros(len(options), dtype=torch.int64)
        if len(due):
            pick[due] = self.guard.prefer(options[due], self._begun(due))
        return pick

    def decide(self, x: Tensor, seen: Tensor, due: Tensor) -> tuple[Decision, Tensor]:
        """Decisions, and actions (rows, m), where those in rows `due` plan for what they see of `x`."""
        if len(due):
            new = self.guard.decide(seen[due], self._begun(due))
            whole = self.decision is None or len(due) == len(x)
            self.decision = new if self.decision is None or whole else self.decision.with_new(due, new)
            self.age = torch.zeros(len(x), dtype=torch.int64) if whole else self.age.index_fill(0, due, 0)
        assert self.decision is not None
        action = self.decision.later(self.age).action
        self.age, self.before = self.age + 1, x
        return self.decision, action

    def _begun(self, due: Tensor) -> Decision | None:
        return None if self.decision is None else self.decision.of(due).later(self.age[due])


def drive(
    guard: Guard, make: WorldType, setting: Setting, recorder: Recorder, tick: Tick | None = None
) -> None:
    """Deploy in fresh worlds, one a seed, into `recorder`.

    Raises:
        SystemFileError: S207, a world fails; S302, it gives states that are no numbers.
        RunError: R402, a plan that is no number would have to be executed.
    """
    worlds, pilot = Worlds(guard.task, make, setting), _Pilot(guard, setting)
    x = worlds.reset()
    recorder.start(x, worlds.worlds[0])
    recorder.units = dict(worlds.worlds[0].units())
    for step in range(setting.steps):
        due = pilot.due(x, step)
        seen = worlds.disturbance.seen(x, step) if len(due) else x
        options = worlds.options(x)
        if options is not None:
            chosen = worlds.choose(pilot.prefer(options + (seen - x)[:, None], due), x)
            seen, x = seen + (chosen - x), chosen
            recorder.chosen(x, options)
        decision, action = pilot.decide(x, seen, due)
        if not bool(torch.isfinite(action).all()):
            raise RunError(Diagnostic("R402", f"the policy's plan at step {step} is not a number"))
        x = worlds.advance(x, action, step + 1)
        recorder.step(decision, action, x, worlds.worlds[0])
        recorder.progress = tuple(dict(world.progress()) for world in worlds.worlds)
        if tick is not None:
            tick(step + 1, setting.steps)
