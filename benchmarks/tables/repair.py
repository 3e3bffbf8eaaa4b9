"""Repair of rejected plans: success rate and processor time of each repair method.

Each method runs in the same states of closed-loop simulations under the paper's guard, one agent at a time.
The methods are gradient refinement, a short and a long local search, gradient refinement followed by local
search, and the full guard.
"""

from __future__ import annotations

from itertools import product
from typing import Annotated

import typer

from benchmarks.options import Output, RunsArgument, SeedsOption, opened
from benchmarks.repairs import Mended, repairs
from benchmarks.table import Columns, Table, measured_here, publish
from benchmarks.timing import one_thread
from stlc.cli.framework.program import command
from stlc.controller.run.run import Run
from stlc.options import parse_seeds

TEXT = """## Repair of a plan

Written by `python -m benchmarks repair`: states of deployments under the paper's guard in which neither the
policy's plan nor the previous one satisfies the specification. `repaired` counts the states for which a
method finds a satisfying plan, among those for which any method or a search finds one; `safe` counts the
same for the requirements tagged `@safety`. Milliseconds of processor time for one agent on one thread. A
local search tries 2,000 plans from each of the two rejected plans, a long one 32,000.
"""
_OUTPUT = Output()

COLUMNS: Columns[Mended] = {
    "benchmark": lambda row: f"{row.benchmark}, {row.scenario}" if row.scenario else row.benchmark,
    **{"way": "{way}", "repaired": "{mended} of {solvable}", "safe": "{saved} of {savable}"},
    **{"median": "{times.median:.2f}", "99 %": "{times.p99:.2f}"},
}


@command(
    "python -m benchmarks repair",
    "python -m benchmarks repair runs/ship_track/latest --scenario shifted --page docs/benchmarks.md",
)
def repair(
    runs: RunsArgument = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            "--scenario", metavar="NAME", help="One to try besides the system as it is; repeatable."
        ),
    ] = None,
    samples: Annotated[int, typer.Option("--samples", metavar="N", min=1, help="States a policy.")] = 300,
    seeds: SeedsOption = "100,101",
    output: Output = _OUTPUT,
) -> None:
    """Count the rejected plans that each repair method repairs, and time it.

    The methods are gradient refinement, local search, both, and the full guard. They run in the same states
    of closed-loop simulations.
    """
    cells = product(opened(runs), ("", *(scenario or ())))
    rows = (
        row
        for folder, name in cells
        for row in repairs(Run.open(folder.path, scenario=name or None), samples, parse_seeds(seeds), name)
    )
    message = "{benchmark}, {way}: {mended} of {solvable} repaired"
    table = Table("repair", rows, lambda row: row, COLUMNS, message)
    with one_thread():
        lines = lambda: [TEXT, *table.markdown(), "", measured_here()]  # noqa: E731
        publish("repair", output, lines, {"rows": table})
