"""Training states: fresh ones, a fixed set, those that missions pass through, and solved hard ones.

Where a specification has memory (clock, statuses, timers), a state is worth training on only if a mission
gets there: the memory must fit the position. So many missions are simulated side by side with the plans of
the policy as it is, and the states on their way are handed out. A mission ends when it is over or lost, and
often where no plan satisfies the specification; another one begins in its place. At first missions end early;
as a policy learns they get further, and plans that search has found for failing states carry some on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeAlias

import torch
from torch import Tensor

from stlc.controller.policies.policy import plan_judged
from stlc.controller.problem.task import satisfied
from stlc.native import never

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import PlanVerdicts, Task
    from stlc.native import Stop

BLOCK = 8192


class Supply(Protocol):
    """Source of training states."""

    def take(self, n: int) -> Tensor:
        """The next `n` states, (n, dim), float32."""

    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Take note of plans that solve states which a policy fails on: (k, n), (k, T, m)."""

    def tensors(self) -> dict[str, Tensor]:
        """All that goes on counting, by name."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where `tensors` were taken."""


class Draws:
    """Independent initial states.

    Attributes:
        block: drawn and not yet handed out, (k, n).
    """

    def __init__(self, task: Task, generator: torch.Generator, device: torch.device) -> None:
        self._task = task
        self._generator = generator
        self._device = device
        self.block = torch.empty(0, len(task.names), device=device)

    def take(self, n: int) -> Tensor:
        """`n` fresh states, (n, dim), float32."""
        while self.block.shape[0] < n:
            drawn = self._task.sample(max(n, BLOCK), generator=self._generator, device=self._device)
            self.block = torch.cat((self.block, drawn))
        taken, self.block = self.block[:n], self.block[n:]
        return taken

    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Ignored: draws are independent."""

    def tensors(self) -> dict[str, Tensor]:
        """States drawn and not yet handed out."""
        return {"block": self.block}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where `tensors` were taken."""
        self.block = tensors["block"].to(self._device)


class FixedSet:
    """A training set: states of another supply, handed out in a new order each time it has been used up.

    Attributes:
        states: all of them, (size, n).
        queue: indices of those that are still to come, (k,).
    """

    def __init__(self, fresh: Supply, size: int, generator: torch.Generator) -> None:
        self._generator = generator
        self.states = fresh.take(size)
        self.queue = torch.empty(0, dtype=torch.int64, device=self.states.device)

    def take(self, n: int) -> Tensor:
        """The next `n` states, (n, dim), float32."""
        size = self.states.shape[0]
        while self.queue.shape[0] < n:
            order = torch.randperm(size, generator=self._generator)
            self.queue = torch.cat((self.queue, order.to(self.states.device)))
        taken, self.queue = self.queue[:n], self.queue[n:]
        return self.states[taken]

    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Ignored: the set is fixed."""

    def tensors(self) -> dict[str, Tensor]:
        """The set, and what of it is still to come."""
        return {"states": self.states, "queue": self.queue}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where `tensors` were taken."""
        self.states, self.queue = (tensors[name].to(self.states.device) for name in ("states", "queue"))


Planner: TypeAlias = Callable[[Tensor], "PlanVerdicts"]
"""States (B, n) -> the plans that are followed from there, judged."""

POOL = 2048
GLIMPSES = 4
"""States that are handed out of every leg of a mission."""
STARTS = 0.1
"""Share of mission starts among the states that are handed out."""
ROUNDS = 5
"""Rounds over which a mission without end is simulated."""
GIVE_UP = 0.3
"""Chance that a mission ends with a leg whose plan fails."""


class Missions:
    """States on the way of missions that are driven by a planner.

    Attributes:
        block: visited and not yet handed out, (k, n).
        pool: where missions stand, (POOL, n); none before the first state is asked for.
        age: how many steps each of them is old, (POOL,).
    """

    def __init__(self, task: Task, generator: torch.Generator, device: torch.device, plan: Planner) -> None:
        self._task, self._plan = task, plan
        self._generator, self._device = generator, device
        self.block = torch.empty(0, len(task.names), device=device)
        self.pool = self.block
        self.age = torch.empty(0, device=device)

    def take(self, n: int) -> Tensor:
        """`n` states that were not handed out before, (n, dim), float32."""
        while self.block.shape[0] < n:
            self.block = torch.cat((self.block, self._visited()))
        taken, self.block = self.block[:n], self.block[n:]
        return taken

    @torch.no_grad()
    def follow(self, states: Tensor, plans: Tensor) -> None:
        """Some missions go on where plans lead that solve states which the policy fails on."""
        if len(states) and len(self.pool):
            judged = self._task.judge(states, plans)
            reached = self._at(judged, self._legs(len(states)))
            place = self._order(len(self.pool))
            place = place[: len(states)]
            self.pool[place], self.age[place] = reached[: len(place)], 0.0

    def tensors(self) -> dict[str, Tensor]:
        """States of all missions."""
        return {"block": self.block, "pool": self.pool, "age": self.age}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on where `tensors` were taken."""
        self.block, self.pool, self.age = (
            tensors[name].to(self._device) for name in ("block", "pool", "age")
        )

    # ------------------------------------------------------------------ driving

    @torch.no_grad()
    def _visited(self) -> Tensor:
        """Drive every mission for one leg, and return states on the way in random order, (k, n)."""
        if not len(self.pool):
            self.pool, self.age = self._starts(POOL), torch.zeros(POOL, device=self._device)
        judged = self._plan(self.pool)
        legs = self._legs(len(self.pool))
        shares = [self._rand(len(legs)) for _ in range(GLIMPSES - 1)]
        glimpses = [self._at(judged, (legs * share).long()) for share in shares]
        self.pool, self.age = self._at(judged, legs), self.age + legs
        seen = torch.cat((*glimpses, self.pool))
        seen = seen[self._task.alive(seen)]
        self._begin_anew(satisfied(judged.rho))
        starts = self._starts(max(int(STARTS * len(seen)), 1))
        seen = torch.cat((seen, starts))
        return seen[self._order(len(seen))]

    def _begin_anew(self, good: Tensor) -> None:
        """New missions for those that are over or lost, and for some whose plan failed."""
        given_up = ~good & (self._rand(len(good)) < GIVE_UP)
        ended = (self.age > mission_steps(self._task)) | ~self._task.alive(self.pool) | given_up
        place = ended.nonzero()[:, 0]
        self.pool[place], self.age[place] = self._starts(len(place)), 0.0

    def _legs(self, n: int) -> Tensor:
        """Steps over which plans are followed, up to half of the horizon, (n,) int64."""
        most = max(self._task.horizon // 2, 1)
        return torch.randint(1, most + 1, (n,), generator=self._generator).to(self._device)

    def _at(self, judged: PlanVerdicts, steps: Tensor) -> Tensor:
        """Predicted states after so many steps, one number a row: (n, dim)."""
        return torch.stack([judged.columns[name].gather(0, steps[None])[0] for name in self._task.names], 1)

    def _starts(self, n: int) -> Tensor:
        return self._task.sample(n, generator=self._generator, device=self._device)

    def _rand(self, n: int) -> Tensor:
        return torch.rand(n, generator=self._generator).to(self._device)

    def _order(self, n: int) -> Tensor:
        return torch.randperm(n, generator=self._generator).to(self._device)


def mission_steps(task: Task) -> int:
    """Steps of a mission: past the last one that is named; of one without end, some rounds."""
    named, recurring = task.compiled.mission, task.compiled.recurring
    if named is None:
        return task.horizon * 4
    if recurring is None:
        return named + task.horizon
    return named + ROUNDS * max(task.horizon, recurring)


@torch.no_grad()
def visited(task: Task, policy: Policy, n: int, seed: int, enough: Stop = never) -> Tensor:
    """`n` states that missions pass through when the policy drives them, (n, dim) float64.

    Missions are driven no further once `enough` says so.
    """
    generator = torch.Generator().manual_seed(seed)
    stride = max(task.horizon // 10, 1)
    legs = mission_steps(task) // stride + 1
    x = task.sample(max(64, 2 * n // legs), generator=generator, dtype=torch.float64)
    seen = [x]
    for _ in range(legs):
        if enough():
            break
        _, judged = plan_judged(task, policy, x)
        x = torch.stack([judged.columns[name][stride] for name in task.names], 1)
        x = x[task.alive(x)]
        seen.append(x)
    states = torch.cat(seen)
    while len(states) < n:
        fresh = task.sample(n - len(states), generator=generator, dtype=torch.float64)
        states = torch.cat((states, fresh))
    return states[torch.randperm(len(states), generator=generator)[:n]]


CAPACITY = 20_000


@dataclass(slots=True)
class ReplayBuffer:
    """A ring of solved hard states.

    Attributes:
        states: (capacity, n).
        plans: (capacity, T, m).
        count: solved states ever added; the newest `min(count, capacity)` are kept.
    """

    states: Tensor
    plans: Tensor
    count: int = 0

    @classmethod
    def empty(cls, state: int, steps: int, controls: int, device: torch.device) -> ReplayBuffer:
        """A buffer without entries for states of `state` columns and plans of `steps` x `controls`."""
        return cls(
            torch.zeros(CAPACITY, state, device=device), torch.zeros(CAPACITY, steps, controls, device=device)
        )

    def __len__(self) -> int:
        return min(self.count, CAPACITY)

    @property
    def bank(self) -> Tensor:
        """Plans of all entries, (len, T, m)."""
        return self.plans[: len(self)]

    def add(self, states: Tensor, plans: Tensor) -> None:
        """Append (k, n) states and (k, T, m) plans, the oldest go first."""
        index = (torch.arange(states.shape[0], device=states.device) + self.count) % CAPACITY
        self.states[index], self.plans[index] = states, plans
        self.count += states.shape[0]

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """`n` entries with replacement: (n, dim), (n, T, m)."""
        index = torch.randint(len(self), (n,), generator=generator).to(self.states.device)
        return self.states[index], self.plans[index]
