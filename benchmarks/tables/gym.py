"""Speed of the environments of `stlc.gym`: steps per second of processor time on one thread.

Many environments run whole episodes together: steps, observations, rewards, final verdicts, and the sampling
of the next initial states. Their random actions are drawn before the measurement.
"""

from __future__ import annotations

from typing import Annotated

import typer

from benchmarks.episodes import EpisodeSpeed, episode_speed
from benchmarks.options import OnlyOption, Output, chosen
from benchmarks.store import BENCHMARKS, load
from benchmarks.table import Columns, Table, measured_here, publish
from benchmarks.timing import one_thread
from stlc.cli.framework.program import command
from stlc.controller.problem.environments import Reward, require_reward

COUNTS = (8, 64, 512, 2048)
TEXT = """Written by `python -m benchmarks gym`. Steps of all environments a second of processor time on one
thread, by the number of environments; whole episodes with random actions drawn beforehand,
`normalised=True`, `reward="{reward}"`.
"""
_OUTPUT = Output()


@command("python -m benchmarks gym", "python -m benchmarks gym --only traffic --page docs/gym.md")
def gym(
    only: OnlyOption = None,
    envs: Annotated[
        list[int] | None,
        typer.Option("--envs", metavar="N", min=1, help="Environments in a batch; 8, 64, 512 and 2048."),
    ] = None,
    reward: Annotated[str, typer.Option("--reward", help="task, robustness or accuracy.")] = "task",
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.0, help="Seconds of measurement for a number.")
    ] = 2.0,
    output: Output = _OUTPUT,
) -> None:
    """Time the environments of `stlc.gym`.

    The table shows steps per second of processor time on one thread, summed over all environments.
    """
    names, counts = chosen(only, BENCHMARKS, "benchmark"), tuple(envs or COUNTS)
    for name in names:
        require_reward(load(name), reward)
    wanted: Reward = reward  # type: ignore[assignment]
    table = Table(
        "gym",
        names,
        lambda name: episode_speed(name, load(name), counts, reward=wanted, seconds=seconds),
        _columns(counts),
    )
    lines = lambda: [TEXT.format(reward=reward), *table.markdown(), "", measured_here()]  # noqa: E731
    with one_thread():
        publish("gym", output, lines, {"rows": table})


def _columns(counts: tuple[int, ...]) -> Columns[EpisodeSpeed]:
    """Return the columns of the table: one for each number of environments."""
    rates = {f"{count:,}": _rate(i) for i, count in enumerate(counts)}
    return {"benchmark": "{benchmark}", **rates}


def _rate(index: int) -> str:
    return f"{{rates[{index}]:,.0f}}"
