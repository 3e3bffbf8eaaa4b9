"""Time of the robustness of whole traces, against one pass over memory and against plain torch.

A pass is `x.clone()`, and with gradients its backward too, over one signal of the same size. Traces are
float32 on one thread; robustness is computed at every sample, with windows clipped at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import median
from typing import Annotated

import torch
import typer
from torch import Tensor

from benchmarks.formulas import CASES, Case
from benchmarks.table import Table, show
from benchmarks.timing import interleaved, one_thread, ratio
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.program import command
from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.torch.ops import TORCH

SAMPLES = (20, 100, 1000, 10_000)
TRACES = (1, 1000)

_MOST_PLAIN = 1 << 21
"""Number of elements from which on plain torch is omitted: it takes minutes, or exhausts the memory."""


@dataclass(frozen=True, slots=True)
class Timing:
    """One formula at one size.

    Attributes:
        formula: name.
        samples: of a trace.
        traces: their number.
        width: of its windows, in steps.
        gradient: with the backward pass.
        seconds: processor time.
        passes: time as a multiple of one pass over memory.
        plain: time of plain torch as a multiple of ours; None if omitted.
    """

    formula: str
    samples: int
    traces: int
    width: int
    gradient: bool
    seconds: float
    passes: float
    plain: float | None

    @property
    def time(self) -> str:
        """The seconds with a unit."""
        return f"{self.seconds * 1e3:.2f} ms" if self.seconds >= 1e-3 else f"{self.seconds * 1e6:.0f} us"


COLUMNS: dict[str, Callable[[Timing], str]] = {
    "formula": lambda row: row.formula,
    "samples": lambda row: str(row.samples),
    "traces": lambda row: str(row.traces),
    "w": lambda row: str(row.width),
    "": lambda row: "with gradient" if row.gradient else "",
    "time": lambda row: row.time,
    "passes": lambda row: f"{row.passes:.1f}x",
    "plain torch": lambda row: "" if row.plain is None else f"{row.plain:.1f}x",
}


@command("python -m benchmarks robustness", "python -m benchmarks robustness --samples 1000 --traces 1000")
def robustness(
    samples: Annotated[
        list[int] | None,
        typer.Option("--samples", metavar="N", min=2, help="Length of a trace; 20, 100, 1000 and 10000."),
    ] = None,
    traces: Annotated[
        list[int] | None, typer.Option("--traces", metavar="N", min=1, help="How many; 1 and 1000.")
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.0, help="Seconds of measurement for a row.")
    ] = 0.3,
    as_json: JsonOption = False,
) -> None:
    """Time the robustness of whole traces, forward and backward.

    On one thread. `passes` is the time as a multiple of one pass over a signal (clone, and its backward);
    `plain torch` is how many times longer plain torch takes.
    """
    with one_thread():
        table = timings(samples or SAMPLES, traces or TRACES, seconds)
        show("robustness", {"rows": table}, as_json=as_json)


def timings(
    samples: Iterable[int] = SAMPLES, traces: Iterable[int] = TRACES, seconds: float = 0.3
) -> Table[tuple[Case, tuple[int, int], bool], Timing]:
    """All formulas at all sizes, without and with gradients.

    Args:
        samples: lengths of traces.
        traces: numbers of traces.
        seconds: approximate measurement time per row.
    """
    lengths = tuple(samples)
    cells = [
        (case, (length, batch), gradient)
        for batch in traces
        for length in lengths
        for case in CASES
        for gradient in (False, True)
    ]
    return Table(
        "robustness",
        cells,
        lambda cell: _time(cell[0], cell[1], gradient=cell[2], seconds=seconds),
        COLUMNS,
        lambda row: f"{row.formula}, {row.samples} samples x {row.traces} traces",
    )


def width_of(samples: int) -> int:
    """Steps of a window: a tenth of the trace, and at least 5."""
    return max(samples // 10, 5)


def _time(case: Case, shape: tuple[int, int], *, gradient: bool, seconds: float) -> Timing:
    x, y, data, weights = _arrays(shape)
    width = width_of(shape[0])
    formula = case.formula(width)
    todo: list[Callable[[], Tensor]] = [
        lambda: data.clone(),
        lambda: robustness_signal(formula, {"x": x, "y": y}, ops=TORCH, end="truncate"),
    ]
    if x.numel() <= _MOST_PLAIN:
        todo.append(lambda: case.plain(x, y, width))
    leaves = (x, y, data)
    wrapped = [_backward(each, weights, leaves) if gradient else _forward(each) for each in todo]
    floor, ours, *plain = interleaved(wrapped, seconds)
    slower = ratio(plain[0], ours) if plain else None
    return Timing(case.name, *shape, width, gradient, median(ours), ratio(ours, floor), slower)


def _arrays(shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x, y, data, weights = (torch.randn(shape, generator=generator) for _ in range(4))
    return x.requires_grad_(), y.requires_grad_(), data.requires_grad_(), weights


def _forward(function: Callable[[], Tensor]) -> Callable[[], None]:
    def run() -> None:
        with torch.no_grad():
            function()

    return run


def _backward(
    function: Callable[[], Tensor], weights: Tensor, leaves: tuple[Tensor, ...]
) -> Callable[[], None]:
    def run() -> None:
        for leaf in leaves:
            leaf.grad = None
        function().backward(weights)  # type: ignore[no-untyped-call]

    return run
