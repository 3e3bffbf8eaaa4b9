"""Options of a training, and the numbers that a method makes of them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, get_args

import torch

from stlc.controller.training.budget import Clock, StepSchedule, cores
from stlc.registry import METHODS

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

ENGINE_VERSION = 2
"""Raised with every change of what the engine reaches; figures that another one made are taken anew."""

DRIVES = 400
"""Drives under one guard after a training, at most."""
HELD_OUT = 5000
HELD_OUT_SEED = 981_273
"""Seed of the held-out states: used for reports only, never while training or tuning."""

MISSION_HOLD = 0.7
"""On missions the states to learn from change while a policy gets further: the rate falls late."""
MISSION_MOST = 128
"""Failing states of missions are alike: many stand where nothing can be done any more."""


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Options of the user; None leaves the choice to the system file, then to the method.

    Attributes:
        method: a name of `stlc.registry.METHODS`.
        budget: seconds, the verdict included; planned as steps again and again.
        clock: of the budget.
        steps: of the optimiser, or the schedule of a run with a budget; wins over `budget`.
        seed: of everything random in training.
        device: of torch.
        threads: of torch; None leaves a core to the search beside it.
        plans: number of plans of the network.
        lr: peak learning rate.
        batch: fresh states a step.
        held_out: states of the last verdict.
        drives: after the training, under one guard at most; 0: none.
    """

    method: str | None = None
    budget: float | None = None
    steps: int | StepSchedule | None = None
    seed: int | None = None
    device: str = "cpu"
    threads: int | None = None
    plans: int | None = None
    lr: float | None = None
    batch: int | None = None
    held_out: int = HELD_OUT
    clock: Clock = "wall"
    drives: int = DRIVES


@dataclass(frozen=True, slots=True)
class ResolvedConfig:
    """All numbers of a run. They are saved with it.

    Attributes:
        method: as told.
        seed: as told.
        hidden: widths of the network.
        plans: number of plans of the network.
        batch: fresh states a step.
        hard: solved hard states a step, once there are any.
        lr: peak learning rate.
        warmup: share of the steps over which it rises.
        hold: share of the steps over which it stays at its peak; it rises in a fixed number of steps then.
        clip: bound of the gradient's norm.
        average: decay of the average of the weights.
        pool: fresh states that a search round judges.
        every: steps between search rounds, twice as many where a round repaired little.
        most: failing states that a round repairs at most.
        slope: backward slope of switches, per unit.
        imitation: weight of the distance to a repaired plan.
        share: weight of the mean over plans beside the winner's loss.
        performance: factor of the performance terms.
        held_out: states of the last verdict.
        threads: of torch; sums over other numbers of them round otherwise. 0 leaves what is set.
        samples: size of a fixed training set; 0: fresh states in every step.
        clock: of budgets and of the times on record.
        ranks: processes that train together, each with so many states a step.
        drives: after the training, under one guard at most; 0: none.
    """

    method: str
    seed: int
    hidden: tuple[int, ...]
    plans: int
    batch: int
    hard: int
    lr: float
    warmup: float = 0.03
    hold: float = 0.0
    clip: float = 1.0
    average: float = 0.99
    pool: int = 2048
    every: int = 50
    most: int = 768
    slope: float = 5.0
    imitation: float = 1.0
    share: float = 0.05
    performance: float = 0.3
    held_out: int = HELD_OUT
    threads: int = 0
    samples: int = 0
    clock: Clock = "wall"
    ranks: int = 1
    drives: int = DRIVES


_MOST = {
    **dict.fromkeys(("hidden", "plans", "threads", "ranks"), 65_536),
    **dict.fromkeys(("batch", "hard", "pool", "most", "held_out", "samples", "drives"), 10**8),
    **dict.fromkeys(("warmup", "average"), 1.0),
    "hold": 0.999,
}
"""Greatest values, of shares and of what decides how much memory is taken."""
_POSITIVE = ("hidden", "plans", "batch", "pool", "every", "ranks")


def checked_config(config: ResolvedConfig) -> ResolvedConfig:
    """The same numbers. Raises ValueError where one is of another kind than it must be, or too large."""
    words = {"method": METHODS.names, "clock": get_args(Clock)}
    for field in fields(ResolvedConfig):
        value = getattr(config, field.name)
        if field.name in words:
            if value not in words[field.name]:
                known = ", ".join(words[field.name])
                raise ValueError(f"`{field.name}` is {value!r:.40}, none of {known}")
            continue
        kinds = (int, float) if field.type == "float" else (int,)
        most = _MOST.get(field.name, 1e12)
        each = value if field.name == "hidden" else (value,)
        least = 1 if field.name in _POSITIVE else 0
        if not all(_is_number(number, kinds) and least <= number <= most for number in each):
            raise ValueError(f"`{field.name}` is {value!r:.40}")
    return config


def _is_number(value: object, kinds: tuple[type, ...]) -> bool:
    return isinstance(value, kinds) and not isinstance(value, bool)


def resolve_config(task: Task, config: TrainConfig) -> ResolvedConfig:
    """The numbers of a run: the user's words, then the system file's, then those of the method.

    Raises:
        UsageError: U101, there is no such method.
    """
    name = config.method or task.system.decl.train.method or METHODS.default
    found: ResolvedConfig = METHODS.get(name).resolve(task, config)
    return replace(found, method=name)


def base_config(
    task: Task, config: TrainConfig, *, batch: int = 1, plans: int = 1, searches: bool = False
) -> ResolvedConfig:
    """The numbers that do not depend on the method.

    Args:
        task: what is trained for.
        config: what the user said.
        batch: fresh states a step, by default.
        plans: number of plans of the network, by default.
        searches: whether a search goes on beside the steps: torch leaves a core to it.
    """
    declared = task.system.decl.train
    mission = bool(task.compiled.timers)
    plans = config.plans or plans
    return ResolvedConfig(
        method="",
        seed=declared.seed if config.seed is None else config.seed,
        hidden=task.system.decl.policy.hidden,
        plans=plans,
        batch=config.batch or declared.batch or batch,
        hard=0,
        lr=config.lr or declared.lr or 1e-3,
        hold=MISSION_HOLD if mission else 0.0,
        most=MISSION_MOST if mission else 768,
        share=0.05 if plans > 1 else 0.0,
        held_out=config.held_out,
        threads=config.threads or _threads(searching=searches and config.device == "cpu"),
        clock=config.clock,
        drives=config.drives,
    )


def _threads(*, searching: bool) -> int:
    """Threads of torch: as they are set, or one less than there are cores where a search runs beside it."""
    most = int(torch.get_num_threads())
    return max(1, min(most, cores() - 1)) if searching else most
