"""`stlc bench worlds`: policies in their worlds, without a guard and with each, and the table of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.bench.disturbed import folders_of, row_json
from stlc.cli.bench.options import OutOption, SeedsOption, chosen
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.cli.framework.ranges import parse_limit, parse_seeds

if TYPE_CHECKING:
    from stlc.bench.disturbed import Extent
    from stlc.rundir import RunDir


def worlds(
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="RUN…", help="Runs; the best of `stlc bench paper` if none.")
    ] = None,
    guards: Annotated[
        str, typer.Option("--guards", metavar="NAMES", help="Some of none,paper,full.")
    ] = "none,paper,full",
    seeds: SeedsOption = "0..9",
    agents: Annotated[
        int | None, typer.Option("--agents", min=1, help="In each deployment, at most.")
    ] = None,
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="Of each deployment, at most.")] = None,
    ceiling: Annotated[
        int, typer.Option("--ceiling", min=0, help="Visited states that are searched for a plan.")
    ] = 1000,
    time_limit: Annotated[
        str, typer.Option("--time-limit", metavar="TIME", help="Of a decision of the full guard, or `none`.")
    ] = "100ms",
    out: OutOption = Path("bench"),
    trained: Annotated[
        Path, typer.Option("--runs", metavar="DIR", help="Where `stlc bench paper` has left its runs.")
    ] = Path("runs/bench"),
    page: Annotated[Path, typer.Option("--page", metavar="FILE", help="The page that shows them.")] = Path(
        "docs/worlds.md"
    ),
    as_json: JsonOption = False,
) -> None:
    """Drive what has not been driven yet, and write the table into the page."""
    from stlc.bench.disturbed import GUARDS, NOMINAL, Extent, disturbed_rows, fill, kept_in
    from stlc.bench.results import write_section
    from stlc.bench.worlds_text import FILE, HEADER, table_lines, worlds_section

    modes = [mode for mode in GUARDS if mode in chosen(guards, GUARDS, "guard")]
    limit, which = parse_limit(time_limit), parse_seeds(seeds)
    usual = Extent((NOMINAL,), modes, which, agents, steps, limit, ceiling=ceiling, file=FILE)
    found, kept = [], 0
    for folder in folders_of(runs, out, trained):
        extent = _with_own_worlds(folder, usual)
        for each in fill([folder], extent, out, lambda name: say(f"deploying {name}")):
            found.append(each.document)
            kept += each.kept
            say(f"{each.name}  {'kept' if each.kept else format(each.document['seconds'], '.0f') + ' s'}")
    write_section(page, "worlds", worlds_section(kept_in(out, FILE)))
    rows = disturbed_rows(found)
    if as_json:
        result = {"what": "worlds", "page": str(page), "driven": len(found) - kept, "kept": kept}
        result |= {"rows": [row_json(row) for row in rows]}
        emit_json("bench/1", ok=True, exit_code=0, result=result)
        return
    emit(table([line for row in rows for line in table_lines(row)], header=HEADER, indent=""))
    say(f"written: {page}, {out}")


def _with_own_worlds(folder: RunDir, extent: Extent) -> Extent:
    """The deployment as it is, and the scenarios of the system that have worlds of their own."""
    from stlc.controller.training.run import Run

    declared = Run.open(folder.path).task.system.decl.scenarios
    return replace(extent, scenarios=(*extent.scenarios, *(each.name for each in declared if each.world)))
