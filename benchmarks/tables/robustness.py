"""Time to compute the robustness of whole traces, compared with one pass over memory and with plain torch.

One pass is `x.clone()` for a signal of the same size; if gradients are computed, the pass includes the
backward pass of `x.clone()`. Traces are float32, on one thread. The robustness is computed at every sample.
Time windows are cut at the end of the trace.
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

    All times are on one thread. `passes` is the time divided by that of one pass over a signal (`x.clone()`,
    with its backward pass). `plain torch` is the time of plain torch divided by ours.
    """
    with one_thread():
        table = timings(samples or SAMPLES, traces or TRACES, seconds)
        show("robustness", {"rows": table}, as_json=as_json)


def timings(
    samples: Iterable[int] = SAMPLES, traces: Iterable[int] = TRACES, seconds: float = 0.3
) -> Table[Any, Timing]:
    """Return the table of all formulas and all sizes of traces, without and with gradients.

    Args:
        samples: numbers of samples per trace.
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
