"""`stlc bench family`: one policy for all values of a parameter, judged inside and outside of what it saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.cli.bench.options import (
    BudgetOption,
    ClockOption,
    ClusterOption,
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
    from stlc.bench.family import Row
    from stlc.bench.study import Place

HEADER = ("family", "value", "", "budget", "seeds", "accuracy", "known feasible", "share")


def family(
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="NAMES", help="Some of ship_radius,stop_time; all if not given."),
    ] = None,
    budget: BudgetOption = None,
    clock: ClockOption = "wall",
    steps: StepsOption = None,
    seeds: SeedsOption = "0",
    jobs: JobsOption = 1,
    cluster: ClusterOption = None,
    threads: ThreadsOption = 1,
    held_out: Annotated[int, typer.Option("--held-out", min=1, help="States at each value.")] = 2000,
    out: OutOption = Path("bench"),
    runs: RunsOption = Path("runs/bench"),
    page: PageOption = Path("docs/results.md"),
    as_json: JsonOption = False,
) -> None:
    """Train, judge value by value, and write the tables into the page; 60 s if no budget is given."""
    from stlc.bench.family import FAMILIES, LENGTHS, Extent, family_cells, family_rows
    from stlc.bench.results import family_section, write_section
    from stlc.bench.study import Place, valid_results

    names = chosen(only, [each.name for each in FAMILIES], "family")
    families = [each for each in FAMILIES if each.name in names]
    extent = Extent(families, parse_seeds(seeds), lengths_of(budget, steps, LENGTHS, clock), held_out)
    place = Place(out, runs, jobs, threads, cluster)
    filling = filled(family_cells(extent), place)
    failed = [*filling.told()["failed"], *_judge_all(filling.documents, place)]
    documents = valid_results(out, "family")
    write_section(page, "family", family_section(documents, family_rows(documents, out)))
    rows = family_rows(filling.documents, out)
    code = 1 if failed else 0
    if as_json:
        result = {"what": "family", "page": str(page), "results": len(documents), **filling.told()}
        result |= {"failed": failed, "rows": [{**asdict(row), "share": row.share} for row in rows]}
        emit_json("bench/1", ok=code == 0, exit_code=code, result=result)
    else:
        emit(table([_cells(row) for row in rows], header=HEADER, indent=""))
        say(f"written: {page}, {out}")
    raise typer.Exit(code)


def _judge_all(documents: Sequence[dict[str, Any]], place: Place) -> list[dict[str, str]]:
    """Judge the policies at every value; what could not be judged, and why."""
    from stlc.bench.family import family_of, judge
    from stlc.bench.study import cell_of

    failed = []
    for document in documents:
        cell = cell_of(document)
        each = family_of(cell)

        def told(value: float, name: str = f"{cell.name} at {each.parameter}", unit: str = each.unit) -> None:
            say(f"judging {name} = {value:g} {unit}")

        if why := judge(cell, document, place, told):
            say(f"{cell.name}: {why}")
            failed.append({"name": cell.name, "why": why})
    return failed


def _cells(row: Row) -> tuple[str, ...]:
    low, high = row.interval
    return (
        *(row.family, f"{row.value:g}", "inside" if row.inside else "outside", row.length),
        *(str(len(row.seeds)), f"{row.accuracy:.4f} [{low:.4f}, {high:.4f}]"),
        f"{row.feasible:.4f}",
        "" if row.share is None else f"{row.share:.4f}",
    )
