"""Policies under model mismatch, disturbances and noise, without a guard and with one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.drives import (
    NOMINAL,
    SCENARIOS,
    USUAL,
    Deployments,
    Drives,
    guard_of,
    mean_and_half,
    policy_lines,
    rows_of,
)
from benchmarks.options import Output
from benchmarks.store import Result, ResultStore
from benchmarks.table import Table, provenance
from benchmarks.tables.worlds import conclude
from stlc.cli.framework.program import command
from stlc.controller.guard.margins import AUTO

if TYPE_CHECKING:
    from benchmarks.drives import Row

TEXT = """\
Written by `python -m benchmarks disturbed` from `benchmarks/results/disturbed.json`. Each policy is driven
as it is and in worlds that are not as its model says (the scenarios of every system), from the same starts:
without a guard, with the paper's backup policy, with the full guard, and with a full guard that asks safety
requirements for the robustness margin that is measured there (`--margin auto`). `safe agents` is the share
of the viable agents which were safe all the time, `safe starts` the share of their instants from which what
was driven was safe through the window, `satisfied` that of all instants from which it satisfied the
specification. Means over deployment seeds with half of their 95 % intervals (Student's t).
"""
WITHOUT_EVENTS = """\
Where agents are driven unsafely though the model is right and the full guard acts, the world does what no
plan accounts for. Of the starts through whose window there was no exogenous event:
"""
MOST = 0.95
"""Share of safe starts below which unsafe drives are attributed to the world if the model is exact."""
METRICS = {"safe agents": "saved", "safe starts": "saved_starts", "satisfied": "executed_starts"}
"""Columns of each guard."""
TITLES = {"none": "no guard", "paper": "paper's", "full": "full"}
_DRIVES, _OUTPUT = Drives(), Output(Path("docs/worlds.md"))


def table(rows: Sequence[Row]) -> Table[Row, Row]:
    """A row for every policy and scenario, a column for every metric and guard."""
    guards = _guards(rows)
    first = {
        id(row)
        for row, before in zip(rows, [None, *rows], strict=False)
        if not before or before.spec != row.spec
    }
    columns: dict[str, Callable[[Row], str]] = {
        "": lambda row: f"{row.spec}, {row.size}" if id(row) in first else "",
        "scenario": lambda row: row.scenario,
    }
    for what, metric in METRICS.items():
        columns |= {f"{what}, {_title(guard)}": _shown(metric, guard) for guard in guards}
    return Table("disturbed", rows, lambda row: row, columns)


def _guards(rows: Sequence[Row]) -> list[str]:
    """All guards, in their order."""
    found = {guard.partition("+") for row in rows for guard in row.guards}
    ordered = sorted(found, key=lambda parts: ([*TITLES].index(parts[0]), parts[2]))
    return ["".join(parts) for parts in ordered]


def _title(guard: str) -> str:
    mode, _, margin = guard.partition("+")
    return TITLES[mode] + (" with margin" if margin == AUTO else f" with margin {margin}" if margin else "")


def _shown(metric: str, guard: str) -> Callable[[Row], str]:
    return lambda row: mean_and_half(row.metric(guard, metric))


def section(results: Sequence[Result]) -> list[str]:
    """The section of the page: all deployments, starts without exogenous events, policies and machines."""
    rows = rows_of(results)
    lost = [row.spec for row in rows if row.scenario == NOMINAL and _lost_to_the_world(row)]
    columns: Mapping[str, Callable[[Row], str]] = {
        "": lambda row: row.spec,
        "scenario": lambda row: row.scenario,
        "share of starts": _shown("quiet", "none"),
        **{f"safe, {_title(guard)}": _shown("quiet_safe_starts", guard) for guard in _guards(rows)},
    }
    some = [row for row in rows if row.spec in lost]
    quiet = [WITHOUT_EVENTS, *Table("quiet", some, lambda row: row, columns).markdown(), ""] if some else []
    return [
        *(TEXT, *table(rows).markdown(), "", *quiet),
        *(*policy_lines(rows), *provenance(results, "deployments (seeds x agents x steps)")),
    ]


def _lost_to_the_world(row: Row) -> bool:
    """True if unsafe drives are due to the world: the model is exact, and the full guard is active."""
    every, quiet = row.metric("full", "saved_starts"), row.metric("full", "quiet_safe_starts")
    return every is not None and quiet is not None and float(every["mean"]) < min(float(quiet["mean"]), MOST)


@command(
    "python -m benchmarks disturbed",
    "python -m benchmarks disturbed runs/traffic/latest --guards none,paper --seeds 0..2 --steps 60",
)
def disturbed(
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="RUN…", help="Runs; the best of `paper` if none.")
    ] = None,
    scenarios: Annotated[
        str | None,
        typer.Option(
            "--scenarios", metavar="NAMES", help="Such as noise,mismatch-20; the usual ones if none."
        ),
    ] = None,
    guards: Annotated[
        str,
        typer.Option(
            "--guards",
            metavar="NAMES",
            help="Of none,paper,full; +0.2 or +auto behind one asks for a margin.",
        ),
    ] = ",".join(USUAL),
    drives: Drives = _DRIVES,
    output: Output = _OUTPUT,
) -> None:
    """Deploy policies under model mismatch, disturbances and noise, without a guard and with one.

    Stored deployments are reused if run, world, guard and size are unchanged.
    """
    modes = [name for name in map(str.strip, guards.split(",")) if guard_of(name)]
    laid = tuple(name.strip() for name in scenarios.split(",")) if scenarios else SCENARIOS
    deployments = Deployments(ResultStore("disturbed", drives.out), drives)
    for folder in drives.runs(runs):
        deployments.add(folder, laid, modes)
    conclude("disturbed", deployments, output.page or _OUTPUT.page, section, table, as_json=output.as_json)
