"""Sources of training states: independent draws, a fixed set, states along missions, and a replay buffer.

A mission is a closed-loop simulation from an initial state on. If a specification has memory (the time since
the start of the mission, satisfied goals, timers), only states that a mission reaches are useful for
training, because the memory must fit the position. Therefore a pool of missions is simulated with the plans
of the present policy, and the states on the way are returned. A mission is replaced by a new one if it is
over or can no longer satisfy the specification, and often if no satisfying plan is found from its present
state. Early in training missions end soon; later they get further. If a search finds plans from states at
which the policy failed, some missions continue from states that these plans visit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import torch
from torch import Tensor

from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.dynamics.uncertainty.disturbance import Events

BLOCK = 8192


class Supply(ABC):
    """Interface of the sources of training states (initial states of the plans that are trained).

    Attributes:
        block: states drawn and not yet returned, (k, n).
        device: torch device of the states.
    """

    state: ClassVar[tuple[str, ...]] = ("block",)
    """Names of the attributes that determine the next states."""

    def __init__(self, task: Task, generator: torch.Generator, device: torch.device) -> None:
        self.task, self.generator, self.device = task, generator, device
        self.block = torch.empty(0, len(task.system.names), device=device)

    @abstractmethod
    def _more(self, n: int) -> Tensor:
        """Draw some states and return them, (k, dim); k may be more or less than `n`, the number needed."""

    def take(self, n: int) -> Tensor:
        """Return the next `n` states, (n, dim), float32."""
        while self.block.shape[0] < n:
            self.block = torch.cat((self.block, self._more(n)))
        taken, self.block = self.block[:n], self.block[n:]
        return taken

    def follow(self, states: Tensor, plans: Tensor) -> None:  # noqa: B027
        """From now on, also supply states that the plans `plans` visit, if the source can do so.

        `plans`: plans that a search found, (k, T, m), from the states `states`, (k, n). By
        default nothing is done.
        """

    def tensors(self) -> dict[str, Tensor]:
        """Tensors by name; together with the random generator they determine the next states."""
        return {name: getattr(self, name) for name in self.state}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the state from `tensors`, which the method of this name returned."""
        for name in self.state:
            setattr(self, name, tensors[name].to(self.device))


class Draws(Supply):
    """Source of independent initial states."""

    def _more(self, n: int) -> Tensor:
        return self.task.sample(max(n, BLOCK), generator=self.generator, device=self.device)


class FixedSet:
    """A fixed set of training states, drawn once from another source and reshuffled after each pass.

    Attributes:
        states: all states of the set, (size, n).
        queue: indices that remain in this pass, (k,).
    """

    def __init__(self, fresh: Supply, size: int, generator: torch.Generator) -> None:
        self._generator = generator
        self.states = fresh.take(size)
        self.queue = torch.empty(0, dtype=torch.int64, device=self.states.device)

    def take(self, n: int) -> Tensor:
        """Return the next `n` states, (n, dim), float32."""
        size = self.states.shape[0]
        while self.queue.shape[0] < n:
            order = torch.randperm(size, generator=self._generator)
            self.queue = torch.cat((self.queue, order.to(self.states.device)))
        taken, self.queue = self.queue[:n], self.queue[n:]
        return self.states[taken]

    def tensors(self) -> dict[str, Tensor]:
        """The states of the set, and the indices that remain in the present pass."""
        return {"states": self.states, "queue": self.queue}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the state from `tensors`, which the method of this name returned."""
        self.states, self.queue = (tensors[name].to(self.states.device) for name in ("states", "queue"))


Planner: TypeAlias = Callable[[Tensor], "PlanVerdicts"]
"""Function from states (B, n) to verdicts on the plans that are followed from them."""

POOL = 2048
GLIMPSES = 4
"""Number of states returned per leg of a mission (a leg is the part of a plan that is followed)."""
STARTS = 0.1
"""Number of initial states added to the visited states, as a share of the number of visited states."""
GIVE_UP = 0.3
"""Probability that a mission ends after a leg whose plan fails."""


class Missions(Supply):
    """Source of states along missions that are simulated with a policy.

    Attributes:
        block: visited states not yet returned, (k, n).
        pool: present states of the missions, (POOL, n); empty before the first call of `take`.
        age: steps since the start of each mission, (POOL,).
    """

    state = ("block", "pool", "age")

    def __init__(self, task: Task, generator: torch.Generator, device: torch.device, plan: Planner) -> None:
        super().__init__(task, generator, device)
        self._plan, self.pool = plan, self.block
        self.age = torch.empty(0, device=device)

    @torch.no_grad()
    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Continue some missions from states that `plans` visit.

        `states`: states at which the policy failed, (k, n). `plans`: plans that a search found from there,
        (k, T, m). Each plan contributes the state that it reaches after a random number of steps.
        """
        if len(states) and len(self.pool):
            judged = self.task.judge(states, plans)
            reached = self._at(judged, self._legs(len(states)))
            place = self._order(len(self.pool))
            place = place[: len(states)]
            self.pool[place], self.age[place] = reached[: len(place)], 0.0

    # ------------------------------------------------------------------ simulation

    @torch.no_grad()
    def _more(self, _n: int) -> Tensor:
        """Simulate every mission under its present plan for a random number of steps.

        Returns:
            The visited states and some new initial states, in random order, (k, dim).
        """
        if not len(self.pool):
            self.pool, self.age = self._starts(POOL), torch.zeros(POOL, device=self.device)
        judged = self._plan(self.pool)
        clock = self.task.clock
        now = (self.age if clock is None else self.pool[:, clock]).round().long()
        legs = self._legs(len(self.pool)).minimum(self._until_due(now))
        shares = [self._rand(len(legs)) for _ in range(GLIMPSES - 1)]
        glimpses = [self._at(judged, (legs * share).long()) for share in shares]
        self.pool, self.age = self._at(judged, legs), self.age + legs
        if self.task.system.decl.test.events:
            self.pool = self._surprised(self._at(judged, legs - 1), self.pool, now + legs)
        seen = torch.cat((*glimpses, self.pool))
        seen = seen[self.task.alive(seen)]
        failing = ~judged.satisfied
        given_up = failing & (self._rand(len(failing)) < GIVE_UP)
        ended = (self.age > self.task.mission_steps) | ~self.task.alive(self.pool) | given_up
        place = ended.nonzero()[:, 0]
        self.pool[place], self.age[place] = self._starts(len(place)), 0.0
        starts = self._starts(max(int(STARTS * len(seen)), 1))
        seen = torch.cat((seen, starts))
        return seen[self._order(len(seen))]

    def _legs(self, n: int) -> Tensor:
        """Draw numbers of steps to simulate, one for each of `n` plans, (n,) int64.

        Each is between 1 and half of the horizon.
        """
        most = max(self.task.horizon // 2, 1)
        return torch.randint(1, most + 1, (n,), generator=self.generator).to(self.device)

    def _until_due(self, now: Tensor) -> Tensor:
        """Steps after `now`, (POOL,), until the next event that is due at given steps, (POOL,) int64."""
        left = torch.full_like(now, self.task.horizon)
        for event in self.task.system.decl.test.events:
            if event.every is not None:
                left = left.minimum(event.every - now % event.every)
            if event.at is not None:
                left = torch.where(now < event.at, left.minimum(event.at - now), left)
        return left

    def _surprised(self, before: Tensor, x: Tensor, steps: Tensor) -> Tensor:
        """Apply the events of a deployment, which no plan foresees, to the states `x`, (POOL, n).

        `before`: states one step earlier. `steps`: step of each mission, (POOL,).
        """
        own, x = self.task.plain.names, x.clone()
        for step in set(steps.tolist()):
            rows = (steps == step).nonzero()[:, 0]
            events = Events(self.task.system.decl.test.events, own, self.task.system.dt)
            for number, states in ((step - 1, before), (step, x)):
                found, _ = events.apply(states[rows, : len(own)], number, self.generator)
            x[rows, : len(own)] = found
        return x

    def _at(self, judged: PlanVerdicts, steps: Tensor) -> Tensor:
        """Predicted states of the judged plans: the state of plan i after `steps[i]` steps, (n, dim)."""
        return torch.stack(
            [judged.columns[name].gather(0, steps[None])[0] for name in self.task.system.names], 1
        )

    def _starts(self, n: int) -> Tensor:
        return self.task.sample(n, generator=self.generator, device=self.device)

    def _rand(self, n: int) -> Tensor:
        return torch.rand(n, generator=self.generator).to(self.device)

    def _order(self, n: int) -> Tensor:
        return torch.randperm(n, generator=self.generator).to(self.device)


CAPACITY = 20_000


@dataclass(slots=True)
class ReplayBuffer:
    """Ring buffer of hard states (at which the policy failed) with the plans found for them.

    Attributes:
        states: (capacity, n).
        plans: (capacity, T, m).
        count: number of states ever added; the newest `min(count, capacity)` are kept.
    """

    states: Tensor
    plans: Tensor
    count: int = 0

    @classmethod
    def empty(cls, state: int, steps: int, controls: int, device: torch.device) -> ReplayBuffer:
        """Make an empty buffer for states of shape (state,) and plans of shape (steps, controls)."""
        return cls(
            torch.zeros(CAPACITY, state, device=device), torch.zeros(CAPACITY, steps, controls, device=device)
        )

    def __len__(self) -> int:
        return min(self.count, CAPACITY)

    @property
    def library(self) -> Tensor:
        """Plans of all entries of the buffer, (entries, T, m)."""
        return self.plans[: len(self)]

    def add(self, states: Tensor, plans: Tensor) -> None:
        """Append (k, n) states and (k, T, m) plans; the oldest are dropped."""
        index = (torch.arange(states.shape[0], device=states.device) + self.count) % CAPACITY
        self.states[index], self.plans[index] = states, plans
        self.count += states.shape[0]

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw `n` entries with replacement; return their states (n, dim) and plans (n, T, m)."""
        index = torch.randint(len(self), (n,), generator=generator).to(self.states.device)
        return self.states[index], self.plans[index]
