"""Processor time of the environments of `stlc.gym`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from benchmarks.timing import interleaved
from stlc.controller.problem.environments import Reward
from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class EpisodeSpeed:
    """Speed of the environments of one task.

    Attributes:
        benchmark: name of the specification.
        reward: of the steps.
        environments: numbers of environments in a batch.
        rates: steps of all environments a second of processor time, for each number.
    """

    benchmark: str
    reward: str
    environments: tuple[int, ...]
    rates: tuple[float, ...]


def episode_speed(
    name: str, task: Task, environments: Sequence[int], *, reward: Reward, seconds: float
) -> EpisodeSpeed:
    """Time whole episodes: steps, observations, rewards, judgement and the next initial states.

    Args:
        name: of the benchmark.
        task: its task.
        environments: numbers of environments in a batch.
        reward: of the steps.
        seconds: of measurement, for each number.
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
