"""`stlc bench step`: where the time of a training step goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.bench.options import chosen
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table

if TYPE_CHECKING:
    from stlc.bench.step import Speed, StepTiming

_PARTS = ("benchmark", "states", "plans", "network", "verdict", "gradient", "backward", "optimiser")
_STEP_HEADER = (*_PARTS, "step", "search")
_SPEED_HEADER = ("benchmark", "steps", "C", "torch", "authors", "share of the authors'", "verdicts a second")

_TEXT = """## A training step

Written by `stlc bench step`. Milliseconds of processor time on one thread, after {warm} steps; `states` of
a step and `plans` for each of them. `network`: its forward pass; `verdict`: rollout, robustness and cost of
all plans; `gradient`: rollout and robustness of the chosen plans, with gradients; `backward`: of the
network; `step`: all of it, drawing states and imitation included. `search` runs beside it, on another core.
"""

_SPEED = """
2,000 rollouts with exact robustness and its gradient, in milliseconds, as C and in torch; beside them what
a step of the authors' code takes with 2,000 states (with its optimiser). Verdicts are rollouts with
robustness alone.
"""


def step(
    only: Annotated[
        str | None, typer.Option("--only", metavar="NAMES", help="Some of the six; all if not given.")
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.0, help="Seconds of measurement for a benchmark.")
    ] = 2.0,
    warm: Annotated[int, typer.Option("--warm", min=1, help="Training steps before it.")] = 120,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE", help="A page that takes the tables.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print both tables; write them where a page is named."""
    from stlc.bench.cells import BENCHMARKS
    from stlc.bench.results import write_section
    from stlc.bench.step import measured

    steps, speeds = [], []
    for timing, speed in measured(chosen(only, list(BENCHMARKS), "benchmark"), seconds=seconds, warm=warm):
        say(f"{timing.benchmark}: {timing.whole:.1f} ms a step")
        steps.append(timing)
        speeds.append(speed)
    if page is not None:
        write_section(page, "step", _section(steps, speeds, warm))
    if as_json:
        result = {"what": "step", "steps": [asdict(each) for each in steps]}
        result["speeds"] = [asdict(each) for each in speeds]
        emit_json("bench/1", ok=True, exit_code=0, result=result)
        return
    emit(table([_step_row(each) for each in steps], header=_STEP_HEADER, indent=""))
    emit("")
    emit(table([_speed_row(each) for each in speeds], header=_SPEED_HEADER, indent=""))


def _section(steps: Sequence[StepTiming], speeds: Sequence[Speed], warm: int) -> str:
    """Both tables as Markdown, with the machine behind them."""
    from stlc.bench.results import made_here, markdown

    lines = [_TEXT.format(warm=warm), *markdown(_STEP_HEADER, [_step_row(each) for each in steps])]
    lines += [_SPEED, *markdown(_SPEED_HEADER, [_speed_row(each) for each in speeds]), ""]
    return "\n".join([*lines, made_here()])


def _step_row(each: StepTiming) -> tuple[str, ...]:
    times = (each.forward, each.verdict, each.gradient, each.backward, each.optimiser, each.whole)
    return (
        *(each.benchmark, str(each.batch), str(each.plans)),
        *(f"{time:.1f}" for time in times),
        f"{each.search:.1f}",
    )


def _speed_row(each: Speed) -> tuple[str, ...]:
    ours = each.torch if each.native is None else each.native
    return (
        *(each.benchmark, str(each.steps)),
        "" if each.native is None else f"{each.native:.1f}",
        f"{each.torch:.1f}",
        "" if each.reported is None else f"{each.reported:.0f}",
        "" if each.reported is None else f"{100 * ours / each.reported:.1f} %",
        f"{each.verdicts / 1e6:.1f} million",
    )
