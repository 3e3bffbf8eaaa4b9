"""`stlc bench paper`: the six benchmarks trained, judged, searched for their ceilings, and written down."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from stlc.registry import METHODS

if TYPE_CHECKING:
    from stlc.bench.ceilings import Ceiling
    from stlc.bench.paper import Extent, Row
    from stlc.bench.study import Place
    from stlc.rundir import RunDir

HEADER = ("benchmark", "method", "budget", "seeds", "accuracy", "worst seed", "ceiling", "share")


def paper(
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="NAMES", help="Such as traffic,ship_safe; all six if not given."),
    ] = None,
    methods: Annotated[
        str | None, typer.Option("--methods", metavar="NAMES", help="guided,gradient if not given.")
    ] = None,
    budget: BudgetOption = None,
    clock: ClockOption = "wall",
    steps: StepsOption = None,
    seeds: SeedsOption = "0..2",
    passes: Annotated[
        int,
        typer.Option("--passes", min=0, help="Searches for the ceiling, 20,000 plans a state each."),
    ] = 10,
    jobs: JobsOption = 1,
    cluster: ClusterOption = None,
    threads: ThreadsOption = 1,
    held_out: HeldOutOption = 5000,
    out: OutOption = Path("bench"),
    runs: RunsOption = Path("runs/bench"),
    page: PageOption = Path("docs/results.md"),
    as_json: JsonOption = False,
) -> None:
    """Fill the table, search for the ceilings, and write the page; 60 s and 300 s if no budget is given."""
    from stlc.bench.cells import BENCHMARKS
    from stlc.bench.paper import LENGTHS, Extent, paper_cells, paper_rows
    from stlc.bench.study import Place

    extent = Extent(
        chosen(only, BENCHMARKS, "benchmark"),
        [method for method in METHODS if method in chosen(methods, METHODS.names, "method")],
        parse_seeds(seeds),
        lengths_of(budget, steps, LENGTHS, clock),
        held_out,
    )
    place = Place(out, runs, jobs, threads, cluster)
    filling = filled(paper_cells(extent), place)
    search(extent, place, passes)
    documents, ceilings = write_page(place, page)
    wanted = {document["benchmark"]: ceilings[document["benchmark"]] for document in filling.documents}
    rows = paper_rows(filling.documents, {name: known.share for name, known in wanted.items()})
    code = filling.exit_code
    if as_json:
        result = {"what": "paper", "page": str(page), "results": len(documents), **filling.told()}
        result |= {"rows": [_row_json(row) for row in rows]}
        result |= {"ceilings": [asdict(known) for known in wanted.values()]}
        emit_json("bench/1", ok=code == 0, exit_code=code, result=result)
    else:
        emit(table([_cells(row) for row in rows], header=HEADER, indent=""))
        say(f"written: {page}, {out}")
    raise typer.Exit(code)


def search(extent: Extent, place: Place, passes: int) -> None:
    """Search for the ceiling of every benchmark that has results, from the best of its policies."""
    from stlc.bench.ceilings import search_on
    from stlc.bench.study import valid_results

    kept = valid_results(place.out, "paper")  # an ablation is of another system
    documents = [each for each in kept if each["held_out"] == extent.held_out]
    for benchmark in extent.benchmarks:
        own = [document for document in documents if document["benchmark"] == benchmark]
        if own:
            run = best_run(own, place)
            search_on(own, place.out, passes=passes, run=run, told=_teller(benchmark))


def _teller(benchmark: str) -> Callable[[int, int], None]:
    return lambda number, still: say(f"ceiling of {benchmark}: search {number}, {still:,} states open")


def best_run(own: Sequence[Mapping[str, Any]], place: Place) -> RunDir | None:
    """The run of the most accurate policy, if it is still there."""
    from stlc.bench.cells import inputs_of
    from stlc.bench.study import cell_of, newest_run

    best = max(own, key=lambda document: float(document["accuracy"]))
    return newest_run(inputs_of(cell_of(best)), place)


def write_page(place: Place, page: Path) -> tuple[list[dict[str, Any]], dict[str, Ceiling]]:
    """The section of the page and its curves, of all results in the folder that still hold."""
    from stlc.bench.ceilings import ceilings_of
    from stlc.bench.results import draw_paper, paper_section, write_section
    from stlc.bench.study import valid_results

    documents = valid_results(place.out, "paper")
    ceilings = ceilings_of(place.out, documents)
    place_ceilings(place, documents, ceilings)
    picture = draw_paper(documents, ceilings, page.parent)
    write_section(page, "paper", paper_section(documents, ceilings, picture=picture is not None))
    return documents, ceilings


def place_ceilings(
    place: Place, documents: Sequence[dict[str, Any]], ceilings: Mapping[str, Ceiling]
) -> None:
    """Enter the ceilings into the results, so that each says how much of what can be done it does."""
    from stlc.bench.study import write_result

    for document in documents:
        known = ceilings[document["benchmark"]].share
        if document["ceiling"] != known:
            document["ceiling"] = known
            write_result(place, document)


def _cells(row: Row) -> tuple[str, ...]:
    low, high = row.interval
    return (
        *(row.benchmark, row.method, row.length, str(len(row.seeds))),
        f"{row.mean:.4f} [{low:.4f}, {high:.4f}]",
        f"{min(row.accuracies):.4f}",
        "" if row.ceiling is None else f"{row.ceiling:.4f}",
        "" if row.share is None else f"{row.share:.4f}",
    )


def _row_json(row: Row) -> dict[str, Any]:
    return {**asdict(row), "accuracy": row.mean, "share": row.share, "worst_share": row.worst_share}
