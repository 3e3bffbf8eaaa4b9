"""Measurement of processor times: the parts of a training step, and rollouts with verdicts and gradients."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from benchmarks.store import BENCHMARKS
from benchmarks.timing import interleaved
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.switch import StraightThrough
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.learner import Trainer
from stlc.controller.training.objective import loss

MOST_STEPS = 100_000
ROLLOUTS, VERDICTS = 2_000, 16_384
REPORTED = dict(zip(BENCHMARKS, (59.0, 79.0, 83.0, 81.0, 115.0, 181.0), strict=True))
"""Milliseconds of processor time that one step of the authors' code takes with 2,000 states, on one thread:
rollout, smooth robustness, backward and optimiser."""


@dataclass(frozen=True, slots=True)
class StepTiming:
    """Processor time of one training step and of its parts, in milliseconds.

    Attributes:
        benchmark: name of the specification.
        batch: number of states in a step.
        plans: number of plans that the network proposes for each state.
        forward: forward pass of the network.
        verdict: rollout, robustness and cost of all plans, and the choice of the best plan for each state.
        gradient: rollout and robustness of the chosen plans, with gradients.
        backward: backward pass of the network.
        optimiser: gradient clipping, Adam, and the running average of the weights.
        whole: the whole step, including parts that are not listed here.
        search: a round of the search that runs beside the training, divided by the number of steps between
            two rounds.
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
    """Speed of rollouts, verdicts and gradients for one task.

    Attributes:
        benchmark: name of the specification.
        steps: number of steps of a rollout.
        native: milliseconds for 2,000 rollouts with robustness and gradient in C; None without compiled C
            code.
        torch: milliseconds for the same rollouts in torch.
        reported: milliseconds for a training step of the paper authors' code with the same number of states.
        verdicts: number of rollouts with robustness, but without gradient, per second.
    """

    benchmark: str
    steps: int
    native: float | None
    torch: float
    reported: float | None
    verdicts: float

    @property
    def share(self) -> float | None:
        """Our time divided by the time of the authors' code; None if the latter is unknown."""
        ours = self.torch if self.native is None else self.native
        return None if self.reported is None else ours / self.reported


def step_timing(name: str, task: Task, *, seconds: float, warm: int) -> StepTiming:
    """Measure the time of the parts of a training step.

    Args:
        name: name of the benchmark.
        task: task of the benchmark.
        seconds: duration of the measurement.
        warm: number of training steps before the measurement.
    """
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
    """Return the parts of a training step for the states `x0`, as functions without arguments.

    They are, in this order: forward pass; verdict; gradient; forward and backward pass; optimiser.
    """
    task, network, count = trainer.task, trainer.network, trainer.config.plans
    plans = network(x0).detach()
    direction = torch.ones_like(plans)
    chosen = plans[:, 0].clone().requires_grad_()
    states = x0.repeat_interleave(count, 0)

    def verdict() -> None:
        with torch.no_grad():
            judged = task.judge(states, plans.flatten(0, 1))
            task.rank(judged, safety=False).view(-1, count).argmax(1)

    def gradient() -> None:
        value = loss(task, trainer.objective, x0, chosen).mean()
        torch.autograd.grad(value, chosen)

    def both() -> None:
        trainer.optimizer.zero_grad()
        network(x0).backward(direction)

    def optimise() -> None:
        torch.nn.utils.clip_grad_norm_(network.parameters(), trainer.config.clip)
        trainer.optimizer.step(trainer.rate)
        with torch.no_grad():
            for averaged, current in zip(trainer.average.parameters(), network.parameters(), strict=True):
                averaged.lerp_(current, 0.01)

    return (lambda: network(x0)), verdict, gradient, both, optimise


def _searched(trainer: Trainer) -> float:
    """Return the milliseconds of one search for plans, from states for which the network's plans fail."""
    with torch.no_grad():
        x0 = trainer.supply.take(trainer.config.pool)
        plans, judged = trainer.policy.plan_judged(x0)
        bad = (~TOLERANCE.satisfied(judged.rho)).nonzero()[:, 0][: trainer.config.most]
    states, start, library = x0[bad], plans[bad], trainer.buffer.library
    before = time.process_time()
    trainer.searcher.repair(states, start, library)
    return (time.process_time() - before) * 1e3


def speed(name: str, task: Task, *, seconds: float) -> Speed:
    """Measure the time of rollouts with verdicts, and of rollouts with gradients, for about `seconds`."""
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
