"""`stlc bench latency`: how long decisions take, and the table of it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.bench.options import MaybePageOption, SeedsOption, SomeRunsArgument
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.cli.framework.ranges import parse_seeds

if TYPE_CHECKING:
    from stlc.bench.latency import Row, Times

HEADER = ("benchmark", "guard", "median", "99 %", "where it acts: median", "99 %", "decisions")
TEXT = """## A decision

Written by `stlc bench latency`. Milliseconds that one decision for one agent takes on one thread, in states
that are spread evenly over deployments under the paper's guard, and where the guard replaced the policy's
plan. `policy`: its plan, rollout and verdict. With a guard (also `none`): the verdict on the plan that was
begun as well, the choice where the world leaves one (of five stations), and what is tried instead.
"""


def latency(
    runs: SomeRunsArgument = None,
    samples: Annotated[int, typer.Option("--samples", min=2, help="States a policy.")] = 600,
    seeds: SeedsOption = "100,101",
    page: MaybePageOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the table; write it where a page is named."""
    from stlc.bench.latency import rows_of
    from stlc.bench.results import table_section, write_section
    from stlc.rundir import RunDir

    folders = [RunDir.open(name) for name in runs or ["latest"]]
    rows = []
    for row in rows_of(folders, samples=samples, seeds=parse_seeds(seeds)):
        say(f"{row.benchmark}, {row.guard}: {_cell(row.every, 'median')} ms")
        rows.append(row)
    cells = [_cells(row) for row in rows]
    if page is not None:
        write_section(page, "latency", table_section(TEXT, HEADER, cells))
    if as_json:
        result = {"what": "latency", "rows": [asdict(row) for row in rows]}
        emit_json("bench/1", ok=True, exit_code=0, result=result)
        return
    emit(table(cells, header=HEADER, indent=""))


def _cells(row: Row) -> tuple[str, ...]:
    every = (_cell(row.every, "median"), _cell(row.every, "p99"))
    acting = (_cell(row.acting, "median"), _cell(row.acting, "p99"))
    counts = [str(times.samples) if times else "0" for times in (row.every, row.acting)]
    return (row.benchmark, row.guard, *every, *acting, " / ".join(counts))


def _cell(times: Times | None, name: str) -> str:
    return "" if times is None else f"{getattr(times, name):.2f}"
