"""Time of the robustness of whole traces, against one pass over memory and against plain torch.

A pass is `x.clone()`, and with gradients its backward too, over one signal of the same size. Traces are
float32 on one thread; robustness is computed at every sample, with windows clipped at the end.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from typing import Annotated, Any

import typer

from benchmarks.formulas import CASES, Timing, timing_of
from benchmarks.table import Columns, Table, show
from benchmarks.timing import one_thread
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.program import command

SAMPLES = (20, 100, 1000, 10_000)
TRACES = (1, 1000)

COLUMNS: Columns[Timing] = {
    **{"formula": "{formula}", "samples": "{samples}", "traces": "{traces}", "w": "{width}"},
    "": lambda row: "with gradient" if row.gradient else "",
    **{"time": "{time}", "passes": "{passes:.1f}x"},
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
) -> Table[Any, Timing]:
    """All formulas at all sizes, without and with gradients.

    Args:
        samples: lengths of traces.
        traces: numbers of traces.
        seconds: approximate measurement time per row.
    """
    return Table(
        "robustness",
        list(product(traces, samples, CASES, (False, True))),
        lambda cell: timing_of(cell[2], (cell[1], cell[0]), gradient=cell[3], seconds=seconds),
        COLUMNS,
        "{formula}, {samples} samples x {traces} traces",
    )
