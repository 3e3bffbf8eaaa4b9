"""Elapsed time of a training step of `guided` on the processor and on a GPU, for several sizes.

The rollouts and verdicts of a step are C on the processor and torch on a GPU. The search for plans, which
runs beside the steps on the processor in both cases, is not part of the times.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from statistics import median
from typing import Annotated

import torch
import typer

from benchmarks.options import OnlyOption, Output, chosen
from benchmarks.store import BENCHMARKS, load
from benchmarks.table import Columns, Table, measured_here, publish
from stlc.cli.framework.program import command
from stlc.controller.parallel.ddp import find_device
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.learner import Trainer

WIDTHS, BATCHES = (0, 1024), (512, 8192)
"""Widths of the three hidden layers (0: those of the benchmark), and numbers of states in a step."""
STEPS = 100_000
TEXT = """### On a GPU

Written by `python -m benchmarks device`. Elapsed milliseconds of a training step of `guided`, with plans to
imitate, the median of at least three after {warm} others: with the network of the benchmark and with a wide
one, for {few:,} fresh states in a step and for {many:,}. On the processor ({threads}) rollouts and verdicts
are C, on the GPU torch. No search runs beside the steps. If the ratio is above 1, the GPU is faster.
"""
_OUTPUT = Output()


@dataclass(frozen=True, slots=True)
class DeviceRow:
    """Elapsed time of a training step on two devices.

    Attributes:
        benchmark: name of the specification.
        network: widths of the hidden layers, as text.
        batch: number of states in a step.
        processor: milliseconds of a step on the processor.
        device: milliseconds of a step on the other device.
    """

    benchmark: str
    network: str
    batch: int
    processor: float
    device: float

    @property
    def ratio(self) -> float:
        """Time on the processor divided by that on the other device."""
        return self.processor / self.device


COLUMNS: Columns[DeviceRow] = {
    **{"benchmark": "{benchmark}", "network": "{network}", "states": "{batch:,}"},
    **{"processor": "{processor:.1f}", "GPU": "{device:.1f}", "processor / GPU": "{ratio:.2f}"},
}


@command(
    "python -m benchmarks device --device cuda",
    "python -m benchmarks device --only traffic --page docs/benchmarks.md",
)
def device(
    only: OnlyOption = None,
    name: Annotated[str, typer.Option("--device", help="cuda or cuda:N; cpu compares nothing.")] = "cuda",
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.0, help="Seconds of measurement for a number.")
    ] = 2.0,
    warm: Annotated[int, typer.Option("--warm", metavar="N", min=1, help="Training steps before it.")] = 20,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of torch on the processor.")] = 1,
    output: Output = _OUTPUT,
) -> None:
    """Time a training step on the processor and on a GPU, with small and large networks and batches."""
    there = find_device(name)
    names = chosen(only, BENCHMARKS, "benchmark")
    sizes = [(each, width, batch) for each in names for width in WIDTHS for batch in BATCHES]

    def row(size: tuple[str, int, int]) -> DeviceRow:
        here = torch.device("cpu")
        made = [step_time(*size, place, seconds=seconds, warm=warm) for place in (here, there)]
        return replace(made[0], device=made[1].device)

    table = Table("device", sizes, row, COLUMNS, "{benchmark}, {network}, {batch:,}: {ratio:.2f}")
    told = "one thread" if threads == 1 else f"{threads} threads"
    text = TEXT.format(warm=warm, few=BATCHES[0], many=BATCHES[-1], threads=told)
    found = torch.cuda.get_device_name(there) if there.type == "cuda" else str(there)
    lines = lambda: [text, *table.markdown(), "", f"- {found}", measured_here()]  # noqa: E731
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        publish("device", output, lines, {"rows": table})
    finally:
        torch.set_num_threads(before)


def step_time(
    name: str, width: int, batch: int, place: torch.device, *, seconds: float, warm: int
) -> DeviceRow:
    """Measure the elapsed time of a training step on one device; both times of the result are that one.

    Args:
        name: name of the benchmark.
        width: width of three hidden layers; 0 for those of the benchmark.
        batch: number of fresh states in a step.
        place: device of the network and the rollouts.
        seconds: least duration of the measurement; at least three steps are made.
        warm: number of training steps before it.
    """
    task = load(name)
    engine = resolve_config(task, TrainConfig(seed=0, threads=1, batch=batch, device=place.type))
    engine = replace(engine, hidden=(width,) * 3) if width else engine
    trainer = Trainer(task, engine, steps=STEPS, device=place)

    def wait() -> None:
        if place.type == "cuda":
            torch.cuda.synchronize(place)

    for _ in range(2):  # the second validation takes what the search has found; its own search ends as well
        trainer.validate()
        if trainer.repairing is not None:
            trainer.repairing.result()
    for _ in range(warm):
        trainer.advance()
    times: list[float] = []
    stop = time.monotonic() + seconds
    while len(times) < 3 or time.monotonic() < stop:
        wait()
        before = time.monotonic()
        trainer.advance()
        wait()
        times.append(time.monotonic() - before)
    trainer.close()
    each = 1e3 * median(times)
    return DeviceRow(name, "x".join(map(str, engine.hidden)), batch, each, each)
