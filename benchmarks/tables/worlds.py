"""Trained policies in the worlds (simulated environments) of their systems, without and with guards."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import fmean
from textwrap import wrap
from typing import Annotated

import typer

from benchmarks.deployments import (
    NOMINAL,
    DeploymentOptions,
    DeploymentRow,
    Deployments,
    mean_and_half,
    policy_lines,
    publish_deployments,
    rows_of,
)
from benchmarks.options import Output, chosen
from benchmarks.store import Result, ResultStore
from benchmarks.table import WIDTH, Columns, Table, listed, provenance
from stlc.cli.framework.program import command
from stlc.controller.run.run import Run
from stlc.registry import GUARDS

TEXT = """\
Written by `python -m benchmarks worlds` from `benchmarks/results/worlds.json`: one policy for each
specification, the most accurate of `python -m benchmarks paper`, in its world. `share of feasible` is the
share of satisfying plans among those followed in visited states for which a satisfying plan is known (the
followed plan, or one that a search of up to 80,000 plans finds). `viable` agents were driven safely, or a
search finds a plan from their start that is safe through the horizon. From `model-consistent` starts the
world followed the model through the window; some worlds have none. Means over deployment seeds with half of
their 95 % intervals (Student's t).
"""
_OPTIONS, _OUTPUT = DeploymentOptions(), Output(Path("docs/worlds.md"))

Line = tuple[DeploymentRow, str]
"""A row and one of its guards."""


def _share(metric: str) -> Callable[[Line], str]:
    return lambda line: mean_and_half(line[0].metric(line[1], metric))


def _named(line: Line) -> str:
    row, guard = line
    return f"{row.spec}, {row.scenario}, {row.size}" if guard == next(iter(row.guards)) else ""


def _progress(line: Line) -> str:
    """Return the means of the world's metrics as text: `mean speed 4.28, junctions passed 76`."""
    told = line[0].guards[line[1]]["progress"].items()
    return ", ".join(f"{name.replace('_', ' ')} {float(metric['mean']):.3g}" for name, metric in told)


COLUMNS: Columns[Line] = {
    "": _named,
    "guard": lambda line: line[1],
    "plan accuracy": _share("plan_accuracy"),
    "share of feasible": _share("feasible_followed"),
    "plans that are safe": _share("plan_safety"),
    "safe among viable": _share("saved"),
    "safe starts, model-consistent": _share("foreseen_safe_starts"),
    "progress": _progress,
}


def table(rows: Sequence[DeploymentRow]) -> Table[Line, Line]:
    """Return the table: one line per simulation and guard.

    The first line of a simulation names it, with its size (seeds x agents x steps).
    """
    lines = [(row, guard) for row in rows for guard in row.guards]
    return listed("worlds", lines, COLUMNS)


def section(results: Sequence[Result]) -> list[str]:
    """Return the lines of the section: the table, results for seeds without lost agents, and provenance.

    An agent is lost if no safe plan is known from its start.
    """
    rows = rows_of(results)
    told = [line for row in rows for line in wholly_viable(row)]
    made = provenance(results, "deployments (seeds x agents x steps)")
    return [TEXT, *table(rows).markdown(), "", *told, *policy_lines(rows), *made]


def wholly_viable(row: DeploymentRow) -> Iterator[str]:
    """Yield lines with metrics for the seeds in which a safe plan is known from the start of every agent.

    No line is yielded if this holds for all seeds, or for none.
    """
    first = next(iter(row.guards.values()))["metrics"].get("savable") or {"values": ()}
    whole = [index for index, share in enumerate(first["values"]) if share == 1.0]
    if not whole or len(whole) == len(first["values"]):
        return
    parts = []
    for guard, document in row.guards.items():
        accuracy, saved = (document["metrics"][name]["values"] for name in ("plan_accuracy", "saved"))
        chosen_ = [fmean(values[index] for index in whole) for values in (accuracy, saved)]
        parts.append(f"{guard} {chosen_[0]:.3f} and {chosen_[1]:.3f}")
    where = f"in the {len(whole)} of {len(first['values'])} seeds in which every start is viable"
    line = f"- {row.spec}, {row.scenario}: {where}, plan accuracy and share driven safely: {'; '.join(parts)}"
    yield from wrap(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


@command(
    "python -m benchmarks worlds",
    "python -m benchmarks worlds runs/ship_track/latest --seeds 0..9 --guards none,full",
)
def worlds(
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="RUN…", help="Runs; the best of `paper` if none.")
    ] = None,
    guards: Annotated[
        str, typer.Option("--guards", metavar="NAMES", help=f"Some of {','.join(GUARDS)}.")
    ] = "none,paper,full",
    known_feasible: Annotated[
        int,
        typer.Option("--known-feasible", metavar="N", min=0, help="Visited states to check for plans."),
    ] = 1000,
    options: DeploymentOptions = _OPTIONS,
    output: Output = _OUTPUT,
) -> None:
    """Simulate policies in their worlds, without a guard and with each guard, and write the table.

    A world is the simulated environment of a system. Stored simulations with the same policy, system and
    settings are reused. Scenarios with a world of their own are simulated, too.
    """
    modes = [mode for mode in GUARDS if mode in chosen(guards, GUARDS.names, "guard")]
    deployments = Deployments(ResultStore("worlds", options.out), options, known_feasible)
    for folder in options.runs(runs):
        declared = Run.open(folder.path).task.system.decl.scenarios
        deployments.add(folder, (NOMINAL, *(each.name for each in declared if each.world)), modes)
    publish_deployments("worlds", deployments, output, section, table)
