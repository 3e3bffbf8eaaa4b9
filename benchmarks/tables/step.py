"""Time of the parts of a training step, and of rollouts with verdicts and gradients.

All times are processor times on one thread. After some training steps, the parts of a step are repeated in
turn: the forward and backward pass of the network, the verdict on all of its plans, rollout and robustness of
the chosen plans with gradients, and the optimiser.
"""

from __future__ import annotations

from typing import Annotated

import typer

from benchmarks.options import OnlyOption, Output, chosen
from benchmarks.steps import Speed, StepTiming, speed, step_timing
from benchmarks.store import BENCHMARKS, load
from benchmarks.table import Columns, Table, measured_here, publish
from benchmarks.timing import one_thread
from stlc.cli.framework.program import command

WARM = 120
"""Number of training steps before the measurement, so that the search has found plans to learn from."""
TEXT = """## A training step

Written by `python -m benchmarks step`. Milliseconds of processor time on one thread, after {warm} steps;
`states` of a step and `plans` for each of them. `network`: its forward pass; `verdict`: rollout, robustness
and cost of all plans; `gradient`: rollout and robustness of the chosen plans, with gradients; `backward`:
of the network; `step`: all of it, drawing states and imitation included. `search` runs beside it, on
another core.
"""
SPEED_TEXT = """
2,000 rollouts with exact robustness and its gradient, in milliseconds, as C and in torch; beside them what
a step of the authors' code takes with 2,000 states (with its optimiser). Verdicts are rollouts with
robustness alone.
"""
_OUTPUT = Output()

STEPS: Columns[StepTiming] = {
    **{"benchmark": "{benchmark}", "states": "{batch}", "plans": "{plans}", "network": "{forward:.1f}"},
    **{"verdict": "{verdict:.1f}", "gradient": "{gradient:.1f}", "backward": "{backward:.1f}"},
    **{"optimiser": "{optimiser:.1f}", "step": "{whole:.1f}", "search": "{search:.1f}"},
}
SPEEDS: Columns[Speed] = {
    **{"benchmark": "{benchmark}", "steps": "{steps}", "C": "{native:.1f}", "torch": "{torch:.1f}"},
    **{"authors": "{reported:.0f}"},
    "share of the authors'": lambda row: "" if row.share is None else f"{100 * row.share:.1f} %",
    "verdicts a second": lambda row: f"{row.verdicts / 1e6:.1f} million",
}


@command("python -m benchmarks step", "python -m benchmarks step --only traffic --page docs/benchmarks.md")
def step(
    only: OnlyOption = None,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.0, help="Seconds of measurement for a benchmark.")
    ] = 2.0,
    warm: Annotated[int, typer.Option("--warm", metavar="N", min=1, help="Training steps before it.")] = WARM,
    output: Output = _OUTPUT,
) -> None:
    """Time the parts of a training step, and rollouts with verdicts and gradients.

    The table shows milliseconds of processor time on one thread. The search that accompanies the training
    runs on another core.
    """
    names = chosen(only, BENCHMARKS, "benchmark")
    steps = Table(
        "step",
        names,
        lambda name: step_timing(name, load(name), seconds=seconds, warm=warm),
        STEPS,
        "{benchmark}: {whole:.1f} ms a step",
    )
    speeds = Table("speed", names, lambda name: speed(name, load(name), seconds=seconds), SPEEDS)
    text = TEXT.format(warm=warm)
    lines = lambda: [text, *steps.markdown(), SPEED_TEXT, *speeds.markdown(), "", measured_here()]  # noqa: E731
    with one_thread():
        publish("step", output, lines, {"steps": steps, "speeds": speeds})
