"""Worlds (true environments) of all seeds of a deployment, simulated as one batch.

An error in a world's code is reported with its location in the world's file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.controller.deployment.tape import Tape
from stlc.controller.deployment.world_errors import blamed, require_numbers, scene_of, states_of, wrong
from stlc.controller.guard.candidates import Limits
from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import solvable, viable
from stlc.controller.world import Charting, Choosing, Redrawing, WorldType
from stlc.diagnostics import RunError, SystemFileError
from stlc.dynamics.declaration.deployment import TestDecl
from stlc.dynamics.uncertainty.disturbance import Disturbance

REDRAWN = 50
"""Maximum number of draws of one agent's initial state."""

SURPRISE = 1e-6
"""Largest state difference that counts as rounding."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Options of a deployment.

    An agent replans every `replan` steps. It also replans immediately when an exogenous signal (role `env` in
    the system file) has changed. A guard judges plans at run time and replaces bad ones.

    Attributes:
        seeds: random seeds; each has a world of its own.
        agents: number of agents per seed.
        steps: number of steps.
        replan: replanning period in steps.
        limit: time limit of a decision of timed guards, in seconds per agent; None: no limit.
        known_feasible: number of visited states, over all seeds, for which feasibility is checked. A state
            counts as feasible if the followed plan satisfies the specification, or if a search finds another
            plan that satisfies it.
        margin: name of a safety requirement -> robustness margin by which a plan must satisfy it to be
            accepted by a guard.
        paper_limit: time limit of a decision of the other guards; None: no limit.
        draws: for each seed, a point of the unit cube from which its first random numbers are read instead of
            drawn, (dim,); None: all are drawn.
    """

    seeds: tuple[int, ...]
    agents: int
    steps: int
    replan: int = 1
    limit: float | None = 0.1
    known_feasible: int = 0
    margin: Mapping[str, float] = field(default_factory=dict)
    paper_limit: float | None = None
    draws: tuple[NDArray[np.float64], ...] | None = None

    def limited(self, seconds: float | None) -> Setting:
        """Return the same with a time limit of all guards: infinite for no limit, None for the usual ones."""
        if seconds is None:
            return self
        limit = seconds if math.isfinite(seconds) else None
        return replace(self, limit=limit, paper_limit=limit)

    @property
    def limits(self) -> Limits:
        """Limits and margins of the guard's decisions."""
        return Limits(seconds=self.limit, margin=self.margin, paper=self.paper_limit)


class Worlds:
    """Worlds (true environments) of all seeds as one batch; a row is one agent of one seed.

    Every world gets copies of states and actions, which it may modify.

    Raises:
        SystemFileError: S207, a method of a world raises an exception or returns a wrong type or shape; S302,
            it returns states that are not finite. Both have a location in the world's file.
    """

    def __init__(self, task: Task, make: WorldType, setting: Setting) -> None:
        self.task, self.system, self.names = task, task.system, task.plain.names
        self.size = (setting.agents, len(self.names))
        self.seeds = setting.seeds
        self.parts = [setting.agents] * len(setting.seeds)
        self.generators = [torch.Generator().manual_seed(seed) for seed in setting.seeds]
        self.tape: Tape | None = None
        if setting.draws is not None:
            self.tape = Tape(torch.from_numpy(np.stack(setting.draws)))
            self.tape.own(self.generators)
        self.disturbance = Disturbance(task.plain, self.generators, setting.agents)
        if self.tape is not None:
            for stream in self.disturbance.streams:
                self.tape.own(stream)
        self.truths = self.disturbance.truths(task.plain.truth)
        self.eventless = torch.ones(setting.agents * len(setting.seeds), dtype=torch.bool)
        self.worlds = []
        for row, (real, generator) in enumerate(zip(self.truths, self.generators, strict=True)):
            with blamed(make, "__init__", "be made"), self.drawing(row):
                self.worlds.append(make(real, setting.agents, generator))
        self._scene: dict[str, NDArray[Any]] | None = None

    def drawing(self, row: int | None = None) -> AbstractContextManager[None]:
        """Context in which random numbers are read from the points of the setting, if there are any.

        `row`: index of the seed to which numbers from a world's own generators belong.
        """
        return nullcontext() if self.tape is None else self.tape.drawing(row)

    def reset(self) -> Tensor:
        """Return the initial states of a new deployment, (rows, n).

        Parameters of the specification are drawn at random; timers start at their initial values. By default
        any initial state is accepted. With `test: {starts: savable}` in the system file, a search must find a
        safe plan from each initial state; with `feasible`, a plan that satisfies the specification. If the
        search finds none, the world draws this initial state again. The attribute `redrawn` counts the
        repeated draws.

        Raises:
            SystemFileError: S211, a world cannot redraw the initial state of an agent.
            RunError: R405, after the maximum number of draws, there is still an initial state without a plan.
        """
        given = []
        for row, world in enumerate(self.worlds):
            with blamed(world, "reset", "begin"), self.drawing(row):
                given.append(world.reset())
        parts = zip(torch.split(self._checked("reset", given, 0), self.parts), self.generators, strict=True)
        with self.drawing():
            starts = [self.system.with_added(x, generator) for x, generator in parts]
        self.redrawn = 0
        if self.task.system.decl.test.starts == "any":
            return torch.cat(starts)
        return torch.cat(
            [self._with_plans(*each) for each in zip(self.worlds, self.seeds, starts, strict=True)]
        )

    def _with_plans(self, world: object, seed: int, x: Tensor) -> Tensor:
        """Redraw initial states of one seed until a plan is found from each of them.

        Args:
            world: the world of the seed; it draws the initial states.
            seed: the seed, for the error message.
            x: initial states, (agents, n). States from which a search finds a plan are retained.

        Returns:
            The final initial states of the seed, (agents, n).

        Raises:
            SystemFileError: S211, the world cannot redraw an initial state.
            RunError: R405, after the maximum number of draws, there is still an initial state without a plan.
        """
        known = viable if self.task.system.decl.test.starts == "savable" else solvable
        good = known(self.task, x)
        for _ in range(REDRAWN):
            if bool(good.all()):
                return x
            if not isinstance(world, Redrawing):
                raise _cannot_redraw(world, self.task.system.decl.test)
            left = torch.nonzero(~good).squeeze(1)
            self.redrawn += len(left)
            with blamed(world, "redraw", "draw starts again"):
                given = states_of(world, "redraw", world.redraw(left), self.size)
            require_numbers(world, "redraw", given, self.names, f"at step 0 (seed {seed})")
            again = torch.cat((given, x[:, self.size[1] :]), 1)
            good &= (again == x).all(1)
            x, left = again, torch.nonzero(~good).squeeze(1)
            good[left] = known(self.task, x[left])
        starts, bad = self.task.system.decl.test.starts, int((~good).sum())
        plan = "a safe plan" if starts == "savable" else "a plan that satisfies everything"
        message = (
            f"no start from which {plan} is known, in {REDRAWN} draws each, for {bad} agents of seed {seed}"
        )
        weaker = ("`--set test.starts=savable` asks for a safe plan",) if starts == "feasible" else ()
        ways = (*weaker, "`--set test.starts=any` takes them all")
        raise RunError.of("R405", message, help=ways)

    def advance(self, x: Tensor, action: Tensor, step: int) -> Tensor:
        """Simulate step number `step` in all worlds and return the next states, (rows, n).

        `x`: present states, (rows, n). `action`: actions, (rows, m).

        A world computes the states of the system only. The parameters and timers that the specification adds
        to these states are computed here: parameters stay constant, and timers are updated from the true
        states.

        The method also stores the attribute `eventless`, (rows,). An entry is True if no exogenous event
        occurred, that is, if the world's next state equals the one that the true dynamics give.
        """
        known = x[:, : self.size[1]]
        before, given = torch.split(known.clone(), self.parts), []
        with self.drawing():
            acted = self.disturbance.acted(self.system.commanded(x, action).clone())
        acts = torch.split(self.system.planned(x, acted), self.parts)
        if all(truth is self.truths[0] for truth in self.truths):  # one step for all seeds
            alone = self.truths[0].step(torch.cat(before), torch.cat(acts))
        else:
            rows = zip(self.truths, before, acts, strict=True)
            alone = torch.cat([truth.step(state, act) for truth, state, act in rows])
        for row, (world, state, act) in enumerate(zip(self.worlds, before, acts, strict=True)):
            with blamed(world, "advance", f"take step {step}"), self.drawing(row):
                given.append(world.advance(state, act))
        reached = self._checked("advance", given, step)
        self.eventless = ((reached - alone).abs() <= SURPRISE).all(1)
        with self.drawing():
            moved = self.disturbance.pushed(reached, known, step)
        return torch.cat((moved, self.system.added_later(x)), 1)

    def options(self, x: Tensor) -> Tensor | None:
        """Return the states that the agents would have under each option.

        Options are alternatives, for example goals, among which a world lets its agents choose.

        Returns:
            States under each of k options, (rows, k, n); None if the worlds offer no options.
        """
        given = []
        for world in self.worlds:
            if isinstance(world, Choosing):
                with blamed(world, "options", "give options"):
                    states = world.options()
                shape = tuple(states.shape) if isinstance(states, Tensor) else ()
                if len(shape) != 3 or (shape[0], shape[2]) != self.size:
                    form = f"({self.size[0]}, k, {self.size[1]})"
                    raise wrong(world, "options", f"gives no tensor of shape {form}")
                given.append(states.detach().to(torch.float64))
        if not given:
            return None
        options = torch.cat(given)
        later = x[:, None, self.size[1] :].expand(-1, options.shape[1], -1)
        return torch.cat((options, later), 2)

    def choose(self, pick: Tensor, x: Tensor) -> Tensor:
        """Apply to every agent the option with the index in `pick`, (rows,), and return the new states.

        Args:
            pick: index of the option that each agent takes, (rows,) int64.
            x: states before the choice, (rows, n); only their parameters and timers are used.

        Returns:
            States after the choice, (rows, n).
        """
        given = []
        for world, part in zip(self.worlds, torch.split(pick, self.parts), strict=True):
            if isinstance(world, Choosing):
                with blamed(world, "choose", "take a choice"):
                    given.append(world.choose(part))
        return torch.cat((self._checked("choose", given, None), x[:, self.size[1] :]), 1)

    def _checked(self, method: str, given: list[Tensor], step: int | None) -> Tensor:
        """Concatenate the states `given`, which `method` of each world returned: (rows, n).

        Raises:
            SystemFileError: S207, states of a world have a wrong type or shape; S302, they are not finite.
        """
        found = []
        for world, seed, each in zip(self.worlds, self.seeds, given, strict=True):
            x = states_of(world, method, each, self.size)
            when = "" if step is None else f"at step {step} "
            require_numbers(world, method, x, self.names, f"{when}(seed {seed})")
            found.append(x)
        return torch.cat(found)

    # ------------------------------------------------------------- reports of the worlds

    def progress(self) -> tuple[Mapping[str, float], ...]:
        """Progress of the task (name -> number) in the world of each seed, in the order of the seeds."""
        found = []
        for world in self.worlds:
            with blamed(world, "progress", "say its progress"):
                found.append({str(name): float(value) for name, value in world.progress().items()})
        return tuple(found)

    def units(self) -> dict[str, str]:
        """Unit of each entry of `progress` that has one, name -> unit."""
        with blamed(self.worlds[0], "units", "say its units"):
            return {str(name): str(unit) for name, unit in self.worlds[0].units().items()}

    def snapshot(self) -> Mapping[str, NDArray[Any]]:
        """Arrays from which a picture is drawn, given by the world of the first seed.

        Every seed has a world of its own. The shapes of the arrays are the same at every step.
        """
        world = self.worlds[0]
        with blamed(world, "snapshot", "give a snapshot"):
            given = world.snapshot()
        self._scene = scene_of(world, given, self._scene)
        return self._scene

    @property
    def charting(self) -> bool:
        """True if the world of the first seed can map planned states to coordinates in a picture."""
        return isinstance(self.worlds[0], Charting)

    def charted(self, states: Tensor) -> NDArray[np.float64]:
        """Picture coordinates of planned states of the first seed: (agents, k, n) -> (agents, k, 2 or 3)."""
        world = self.worlds[0]
        assert isinstance(world, Charting)
        with blamed(world, "charted", "say where plans are"):
            places = np.asarray(world.charted(states), dtype=np.float64)
        if places.ndim != 3 or places.shape[:2] != states.shape[:2] or places.shape[2] not in (2, 3):
            agents, count = states.shape[:2]
            raise wrong(world, "charted", f"gives places of shape {places.shape}, not ({agents}, {count}, 2)")
        return places


def _cannot_redraw(world: object, test: TestDecl) -> SystemFileError:
    return SystemFileError.of(
        "S211",
        f"the world `{type(world).__name__}` cannot draw the start of one agent again",
        None if test.world is None else test.world.span,
        label="named here",
        note=(f"`starts: {test.starts}` draws starts again from which no plan is known",),
        help=("`--set test.starts=any` takes them all", "a method `redraw` gives agents another start"),
    )
