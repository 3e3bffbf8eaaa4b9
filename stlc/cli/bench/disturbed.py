"""`stlc bench disturbed`: policies under disturbances, without a guard and with one, and the table of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stlc.cli.bench.options import OutOption, PageOption, SeedsOption
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.cli.framework.ranges import parse_limit, parse_seeds
from stlc.diagnostics import Diagnostic, UsageError

if TYPE_CHECKING:
    from stlc.bench.disturbed import Row
    from stlc.rundir import RunDir


RunsArgument = Annotated[
    list[str] | None, typer.Argument(metavar="RUN…", help="Runs; the best of `stlc bench paper` if none.")
]
ScenariosOption = Annotated[
    str | None,
    typer.Option("--scenarios", metavar="NAMES", help="Such as noise,mismatch-20; the usual ones if none."),
]
GuardsOption = Annotated[
    str,
    typer.Option(
        "--guards", metavar="NAMES", help="Of none,paper,full; +0.2 or +auto behind one asks for a margin."
    ),
]
AgentsOption = Annotated[int | None, typer.Option("--agents", min=1, help="In each deployment, at most.")]
StepsOption = Annotated[int | None, typer.Option("--steps", min=1, help="Of each deployment, at most.")]
LimitOption = Annotated[
    str, typer.Option("--time-limit", metavar="TIME", help="Of a decision of the full guard, or `none`.")
]
TrainedOption = Annotated[
    Path, typer.Option("--runs", metavar="DIR", help="Where `stlc bench paper` has left its runs.")
]


def disturbed(
    runs: RunsArgument = None,
    scenarios: ScenariosOption = None,
    guards: GuardsOption = "none,paper,full,full+auto",
    seeds: SeedsOption = "0..9",
    agents: AgentsOption = None,
    steps: StepsOption = None,
    time_limit: LimitOption = "100ms",
    out: OutOption = Path("bench"),
    trained: TrainedOption = Path("runs/bench"),
    page: PageOption = Path("docs/worlds.md"),
    as_json: JsonOption = False,
) -> None:
    """Drive what has not been driven yet, and write the table into the page."""
    from stlc.bench.disturbed import SCENARIOS, Extent, disturbed_rows, fill, guard_of, kept_in
    from stlc.bench.disturbed_text import COLUMNS, disturbed_section
    from stlc.bench.results import write_section

    extent = Extent(
        tuple(name.strip() for name in scenarios.split(",")) if scenarios else SCENARIOS,
        [name for name in map(str.strip, guards.split(",")) if guard_of(name)],
        parse_seeds(seeds),
        agents,
        steps,
        parse_limit(time_limit),
    )
    found, kept = [], 0
    for each in fill(folders_of(runs, out, trained), extent, out, lambda name: say(f"deploying {name}")):
        found.append(each.document)
        kept += each.kept
        say(f"{each.name}  {'kept' if each.kept else format(each.document['seconds'], '.0f') + ' s'}")
    write_section(page, "disturbed", disturbed_section(kept_in(out)))
    rows = disturbed_rows(found)
    if as_json:
        result = {"what": "disturbed", "page": str(page), "driven": len(found) - kept, "kept": kept}
        emit_json("bench/1", ok=True, exit_code=0, result={**result, "rows": [row_json(row) for row in rows]})
        return
    header = (
        "",
        "scenario",
        *(f"{name}: {what}" for what in COLUMNS for name in extent.guards),
    )
    emit(table([_cells(row, extent.guards) for row in rows], header=header, indent=""))
    say(f"written: {page}, {out}")


def folders_of(names: Sequence[str] | None, out: Path, trained: Path) -> list[RunDir]:
    """The runs that are named, else those of the most accurate policies. Raises UsageError (U101)."""
    from stlc.bench.cells import BENCHMARKS
    from stlc.bench.study import Place, valid_results
    from stlc.cli.bench.paper import best_run
    from stlc.rundir import RunDir

    if names:
        return [RunDir.open(name) for name in names]
    documents, place = valid_results(out, "paper"), Place(out, trained)
    own = [[each for each in documents if each["benchmark"] == benchmark] for benchmark in BENCHMARKS]
    found = [run for each in own if each and (run := best_run(each, place)) is not None]
    if not found:
        help_ = ("stlc bench paper  trains them", "stlc bench disturbed RUN  takes any other run")
        raise UsageError(
            Diagnostic("U101", f"there are no policies of the benchmarks in `{trained}`", help=help_)
        )
    return found


def _cells(row: Row, guards: Sequence[str]) -> tuple[str, ...]:
    from stlc.bench.disturbed_text import COLUMNS, spread

    metrics = (row.metric(guard, name) for name in COLUMNS.values() for guard in guards)
    return (row.spec, row.scenario, *map(spread, metrics))


def row_json(row: Row) -> Mapping[str, Any]:
    """A row as plain data."""
    seeds, agents, steps = row.size
    guards = {name: {"metrics": each["metrics"], "acted": each["acted"]} for name, each in row.guards.items()}
    return {
        **{"spec": row.spec, "scenario": row.scenario, "seeds": seeds, "agents": agents, "steps": steps},
        "guards": guards,
    }
