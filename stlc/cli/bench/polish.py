"""`stlc bench polish`: what mends rejected plans, and the table of it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.bench.options import MaybePageOption, SeedsOption, SomeRunsArgument
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.cli.framework.ranges import parse_seeds

if TYPE_CHECKING:
    from stlc.bench.polish import Mended

HEADER = ("benchmark", "way", "mended", "saved", "median", "99 %")
TEXT = """## Mending a plan

Written by `stlc bench polish`: states of deployments under the paper's guard in which neither the policy's
plan nor what is left of the one before satisfies the specification. `mended` are those for which a way finds
a plan that does, of those for which any way or a search finds one; `saved` the same for what is tagged
`@safety`. Milliseconds of processor time for one agent on one thread. A climb tries 2,000 plans from each of
the two, a long one 32,000.
"""


def polish(
    runs: SomeRunsArgument = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            "--scenario", metavar="NAME", help="One to try besides the system as it is; repeatable."
        ),
    ] = None,
    samples: Annotated[int, typer.Option("--samples", min=1, help="States a policy.")] = 300,
    seeds: SeedsOption = "100,101",
    page: MaybePageOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the table; write it where a page is named."""
    from stlc.bench.polish import mended_rows
    from stlc.bench.results import table_section, write_section
    from stlc.rundir import RunDir

    folders = [RunDir.open(name) for name in runs or ["latest"]]
    rows = []
    scenarios = ("", *(scenario or ()))
    for row in mended_rows(folders, scenarios=scenarios, samples=samples, seeds=parse_seeds(seeds)):
        say(f"{row.benchmark}, {row.way}: {row.mended} of {row.solvable} mended")
        rows.append(row)
    cells = [_cells(row) for row in rows]
    if page is not None:
        write_section(page, "polish", table_section(TEXT, HEADER, cells))
    if as_json:
        result = {"what": "polish", "rows": [asdict(row) for row in rows]}
        emit_json("bench/1", ok=True, exit_code=0, result=result)
        return
    emit(table(cells, header=HEADER, indent=""))


def _cells(row: Mended) -> tuple[str, ...]:
    name = f"{row.benchmark}, {row.scenario}" if row.scenario else row.benchmark
    times = ("", "") if row.times is None else (f"{row.times.median:.2f}", f"{row.times.p99:.2f}")
    return (name, row.way, f"{row.mended} of {row.solvable}", f"{row.saved} of {row.savable}", *times)
