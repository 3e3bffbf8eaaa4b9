"""`stlc bench ablation`: the paper's tables for gamma, k, network size and number of samples, made again."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.bench.options import (
    BudgetOption,
    ClockOption,
    ClusterOption,
    HeldOutOption,
    JobsOption,
    OutOption,
    PageOption,
    RunsOption,
    SeedsOption,
    StepsOption,
    ThreadsOption,
    chosen,
    filled,
    lengths_of,
)
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.cli.framework.ranges import parse_seeds

if TYPE_CHECKING:
    from stlc.bench.ablation import Row

HEADER = ("", "value", "budget", "seeds", "training", "held out", "paper: training", "paper: validation")


def ablation(
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="NAMES", help="Some of gamma,k,network,samples; all if not given."),
    ] = None,
    budget: BudgetOption = None,
    clock: ClockOption = "wall",
    steps: StepsOption = None,
    seeds: SeedsOption = "0..2",
    jobs: JobsOption = 1,
    cluster: ClusterOption = None,
    threads: ThreadsOption = 1,
    held_out: HeldOutOption = 5000,
    out: OutOption = Path("bench"),
    runs: RunsOption = Path("runs/bench"),
    page: PageOption = Path("docs/results.md"),
    as_json: JsonOption = False,
) -> None:
    """Fill the tables and write them into the page; 60 s if no budget is given."""
    from stlc.bench.ablation import AXES, LENGTHS, Extent, ablation_cells, ablation_rows
    from stlc.bench.results import ablation_section, write_section
    from stlc.bench.study import Place, valid_results

    axes = chosen(only, [axis.name for axis in AXES], "table")
    extent = Extent(axes, parse_seeds(seeds), lengths_of(budget, steps, LENGTHS, clock), held_out)
    filling = filled(ablation_cells(extent), Place(out, runs, jobs, threads, cluster))
    documents = valid_results(out, "ablation")
    write_section(page, "ablation", ablation_section(documents))
    rows = [row for row in ablation_rows(filling.documents) if row.axis in axes]
    code = filling.exit_code
    if as_json:
        result = {"what": "ablation", "page": str(page), "results": len(documents), **filling.told()}
        result |= {"rows": [{**asdict(row), "accuracy": row.mean} for row in rows]}
        emit_json("bench/1", ok=code == 0, exit_code=code, result=result)
    else:
        emit(table([_cells(row) for row in rows], header=HEADER, indent=""))
        say(f"written: {page}, {out}")
    raise typer.Exit(code)


def _cells(row: Row) -> tuple[str, ...]:
    reported = [f"{value:.3f}" for value in row.reported or ()] or ["", ""]
    return (
        *(row.axis, row.value, row.length, str(row.seeds)),
        *(f"{row.training:.4f}", f"{row.mean:.4f}"),
        *reported,
    )
