"""Measurement of the processor time that the environments of `stlc.gym` take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from benchmarks.timing import interleaved
from stlc.controller.problem.environments import Reward
from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class EpisodeSpeed:
    """Measured speed of the environments of one task.

    Attributes:
        benchmark: name of the specification.
        reward: kind of reward: `task`, `robustness` or `accuracy`.
        environments: tested batch sizes, that is, numbers of environments that run together.
        rates: for each batch size, steps per second of processor time, summed over all environments.
    """

    benchmark: str
    reward: str
    environments: tuple[int, ...]
    rates: tuple[float, ...]


def episode_speed(
    name: str, task: Task, environments: Sequence[int], *, reward: Reward, seconds: float
) -> EpisodeSpeed:
    """Measure the speed of environments over whole episodes.

    An episode includes all steps, observations, rewards, the final verdict, and the sampling of the next
    initial states.

    Args:
        name: name of the benchmark.
        task: task of the benchmark.
        environments: batch sizes to test.
        reward: kind of reward.
        seconds: duration of the measurement for each batch size.
    """
    from stlc.gym import SpecVectorEnv

    rates = []
    for count in environments:
        env = SpecVectorEnv(task, count, reward=reward, normalised=True)
        env.reset(seed=0)
        env.action_space.seed(0)
        actions = [env.action_space.sample() for _ in range(env.steps)]

        def episode(env: SpecVectorEnv = env, actions: list[object] = actions) -> None:
            for action in actions:
                env.step(action)  # type: ignore[arg-type]

        (times,) = interleaved([episode], seconds)
        rates.append(count * env.steps / median(times))
    return EpisodeSpeed(name, reward, tuple(environments), tuple(rates))
