"""`stlc bench step`: where the time of a step of training goes, and how fast verdicts and gradients are.

Processor time on one thread. The parts of a step are run again one by one, in turn, on a trainer that has
taken some steps: forward and backward through the network, the verdict on all of its plans, rollout and
robustness of the chosen ones with their gradient, the optimiser.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.bench.cells import BENCHMARKS, load
from stlc.bench.measure import interleaved, one_thread
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.switch import StraightThrough
from stlc.controller.problem.task import rank, satisfied
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.learner import Trainer
from stlc.controller.training.objective import loss

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

WARM = 120
"""Steps before the measurement: by then the search has found plans to learn from."""
MOST_STEPS = 100_000
ROLLOUTS, VERDICTS = 2_000, 16_384
REPORTED = dict(zip(BENCHMARKS, (59.0, 79.0, 83.0, 81.0, 115.0, 181.0), strict=True))
"""Milliseconds of processor time that one step of the authors' code takes with 2,000 states, on one thread:
rollout, smooth robustness, backward and optimiser."""


@dataclass(frozen=True, slots=True)
class StepTiming:
    """Milliseconds of processor time of one training step, and of what it is made of.

    Attributes:
        benchmark: name of the specification.
        batch: states of a step.
        plans: of the network for each of them.
        forward: of the network.
        verdict: rollout, robustness and cost of all plans, and the choice among them.
        gradient: rollout and robustness of the chosen plans, with gradients.
        backward: of the network.
        optimiser: clipping, Adam, and the average of the weights.
        whole: the step, what is not listed above included.
        search: beside it, in a thread of its own: a round of search by the steps between two.
    """

    benchmark: str
    batch: int
    plans: int
    forward: float
    verdict: float
    gradient: float
    backward: float
    optimiser: float
    whole: float
    search: float


@dataclass(frozen=True, slots=True)
class Speed:
    """Rollouts, verdicts and gradients of one task.

    Attributes:
        benchmark: name of the specification.
        steps: of a rollout.
        native: milliseconds of 2,000 rollouts with robustness and gradient as C; None where torch does it.
        torch: the same in torch.
        reported: of a step of the authors' code with as many states.
        verdicts: rollouts with verdict a second, without gradient.
    """

    benchmark: str
    steps: int
    native: float | None
    torch: float
    reported: float | None
    verdicts: float


def measured(
    names: Iterable[str] = BENCHMARKS, *, seconds: float = 2.0, warm: int = WARM
) -> Iterator[tuple[StepTiming, Speed]]:
    """Times of benchmarks, one after the other.

    Args:
        names: of specifications.
        seconds: of measurement for each, about.
        warm: training steps before it.
    """
    with one_thread():
        for name in names:
            task = load(name)
            yield step_timing(name, task, seconds=seconds, warm=warm), speed(name, task, seconds=seconds)


def step_timing(name: str, task: Task, *, seconds: float, warm: int) -> StepTiming:
    """The parts of a training step of the engine."""
    engine = resolve_config(task, TrainConfig(seed=0, threads=1))
    trainer = Trainer(task, engine, steps=MOST_STEPS, device=torch.device("cpu"))
    for _ in range(warm):
        if trainer.step >= trainer.next_validation:
            trainer.validate()
        trainer.advance()
    if trainer.repairing is not None:
        trainer.repairing.result()
    x0 = trainer.training.take(engine.batch)
    if engine.hard and len(trainer.buffer):
        x0 = torch.cat((x0, trainer.buffer.draw(engine.hard, trainer.generator)[0]))
    search = _searched(trainer)
    parts = [*_parts(trainer, x0), trainer.advance]
    times = [median(each) * 1e3 for each in interleaved(parts, seconds)]
    forward, verdict, gradient, backward, optimiser, whole = times
    return StepTiming(
        *(name, len(x0), engine.plans, forward, verdict, gradient),
        *(max(backward - forward, 0.0), optimiser, whole, search / engine.every),
    )


def _parts(trainer: Trainer, x0: Tensor) -> Sequence[Callable[[], object]]:
    """Forward; verdict; gradient; forward and backward; optimiser."""
    task, network, count = trainer.task, trainer.network, trainer.config.plans
    plans = network(x0).detach()
    direction = torch.ones_like(plans)
    chosen = plans[:, 0].clone().requires_grad_()
    states = x0.repeat_interleave(count, 0)

    def verdict() -> None:
        with torch.no_grad():
            judged = task.judge(states, plans.flatten(0, 1))
            rank(judged.rho, task.cost(judged)).view(-1, count).argmax(1)

    def gradient() -> None:
        value = loss(task, trainer.objective, x0, chosen).total.mean()
        torch.autograd.grad(value, chosen)

    def both() -> None:
        trainer.optimizer.zero_grad()
        network(x0).backward(direction)

    def optimise() -> None:
        torch.nn.utils.clip_grad_norm_(network.parameters(), trainer.config.clip)
        trainer.optimizer.step()
        with torch.no_grad():
            for averaged, current in zip(trainer.average.parameters(), network.parameters(), strict=True):
                averaged.lerp_(current, 0.01)

    return (lambda: network(x0)), verdict, gradient, both, optimise


def _searched(trainer: Trainer) -> float:
    """Milliseconds of a round of search for the states on which the network fails."""
    with torch.no_grad():
        x0 = trainer.supply.take(trainer.config.pool)
        plans, judged = trainer.policy.plan_judged(x0)
        bad = (~satisfied(judged.rho)).nonzero()[:, 0][: trainer.config.most]
    states, start, bank = x0[bad], plans[bad], trainer.buffer.bank
    before = time.process_time()
    trainer.searcher.repair(states, start, bank)
    return (time.process_time() - before) * 1e3


def speed(name: str, task: Task, *, seconds: float) -> Speed:
    """Rollouts with verdicts, and with gradients."""
    x0 = task.sample(VERDICTS, seed=1)
    generator = torch.Generator().manual_seed(2)
    low, high = task.system.control_low, task.system.control_high
    u = low + (high - low) * torch.rand(VERDICTS, task.horizon, len(low), generator=generator)
    some, plan = x0[:ROLLOUTS], u[:ROLLOUTS].clone().requires_grad_()
    slope = 5.0

    def in_torch() -> None:
        columns = task.system.rollout_columns(some, plan, StraightThrough(slope))
        torch.autograd.grad(task.graph.columns(columns, ops=TORCH).sum(), plan)

    def as_c() -> None:
        assert task.gradient is not None
        each, _ = task.gradient(some, plan, slope=slope)
        torch.autograd.grad(task.graph.overall(each).sum(), plan)

    double = x0.double().numpy(), u.double().numpy()

    def verdict() -> None:
        if task.native is None:
            task.judge(x0, u, states=False)
        else:
            task.native.kernel.judge(*double)

    todo: list[Callable[[], object]] = [in_torch, verdict]
    if task.gradient is not None:
        todo.append(as_c)
    torch_time, judging, *native = (median(times) for times in interleaved(todo, seconds))
    return Speed(
        name,
        task.horizon,
        native[0] * 1e3 if native else None,
        torch_time * 1e3,
        REPORTED.get(name),
        VERDICTS / judging,
    )
