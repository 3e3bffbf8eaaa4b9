"""Trained policies under model mismatch, disturbances and noise, without a guard and with several guards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.deployments import (
    NOMINAL,
    SCENARIOS,
    USUAL,
    DeploymentOptions,
    DeploymentRow,
    Deployments,
    guard_of,
    mean_and_half,
    policy_lines,
    publish_deployments,
    rows_of,
)
from benchmarks.options import Output
from benchmarks.store import Result, ResultStore
from benchmarks.table import Columns, Table, listed, provenance
from stlc.cli.framework.program import command
from stlc.controller.guard.kind import named_guard
from stlc.controller.guard.kinds.full import GUARD as FULL
from stlc.controller.guard.margins import AUTO
from stlc.registry import GUARDS

TEXT = """\
Written by `python -m benchmarks disturbed` from `benchmarks/results/disturbed.json`. Each policy is simulated
as it is and under the scenarios of its system, in which the model is wrong, from the same starts: without a
guard, with the paper's backup policy, with the full guard, and with a full guard that requests the robustness
margin measured under the scenario (`--margin auto`) of safety requirements. `safe agents` is the share of the
viable agents that were safe all the time, `safe starts` the share of their instants from which the executed
trajectory was safe through the window, `satisfied` the share of all instants from which it satisfied the
specification. Means over deployment seeds with half of their 95 % intervals (Student's t).
"""
WITHOUT_EVENTS = """\
Where agents violate safety although the model is exact and the full guard acts, the cause is an exogenous
event that no plan accounts for. Results for the starts whose window contains no exogenous event:
"""
MOST = 0.95
"""Share of safe starts below which unsafe drives are attributed to the world if the model is exact."""
METRICS = {"safe agents": "saved", "safe starts": "saved_starts", "satisfied": "executed_starts"}
"""Columns of the table for each guard: title -> name of the metric."""
_OPTIONS, _OUTPUT = DeploymentOptions(), Output(Path("docs/worlds.md"))


def table(rows: Sequence[DeploymentRow]) -> Table[DeploymentRow, DeploymentRow]:
    """Return the table: one row per policy and scenario, one column per metric and guard."""
    guards = _guards(rows)
    first = [next(group) for _, group in groupby(rows, lambda row: row.spec)]
    columns: Columns[DeploymentRow] = {
        "": lambda row: f"{row.spec}, {row.size}" if any(row is each for each in first) else "",
        "scenario": "{scenario}",
        **{
            f"{what}, {_title(guard)}": _shown(metric, guard)
            for what, metric in METRICS.items()
            for guard in guards
        },
    }
    return listed("disturbed", rows, columns)


def _guards(rows: Sequence[DeploymentRow]) -> list[str]:
    """Return the names of all guards in `rows`, in the order of the columns."""
    found = {guard.partition("+") for row in rows for guard in row.guards}
    ordered = sorted(found, key=lambda parts: (named_guard(parts[0]).cost, parts[2]))
    return ["".join(parts) for parts in ordered]


def _title(guard: str) -> str:
    mode, _, margin = guard.partition("+")
    kind = named_guard(mode)
    title = kind.title.removesuffix(" guard") if kind.intervenes else kind.title
    return title + (" with margin" if margin == AUTO else f" with margin {margin}" if margin else "")


def _shown(metric: str, guard: str) -> Callable[[DeploymentRow], str]:
    return lambda row: mean_and_half(row.metric(guard, metric))


def section(results: Sequence[Result]) -> list[str]:
    """Return the lines of the page's section.

    A second table shows results for initial states without exogenous events, if such events make runs unsafe.
    """
    rows = rows_of(results)
    lost = [row.spec for row in rows if row.scenario == NOMINAL and _lost_to_the_world(row)]
    columns: Columns[DeploymentRow] = {
        "": "{spec}",
        "scenario": "{scenario}",
        "share of starts": _shown("quiet", GUARDS.default),
        **{f"safe, {_title(guard)}": _shown("quiet_safe_starts", guard) for guard in _guards(rows)},
    }
    some = [row for row in rows if row.spec in lost]
    uneventful = [WITHOUT_EVENTS, *listed("no events", some, columns).markdown(), ""] if some else []
    return [
        *(TEXT, *table(rows).markdown(), "", *uneventful),
        *(*policy_lines(rows), *provenance(results, "deployments (seeds x agents x steps)")),
    ]


def _lost_to_the_world(row: DeploymentRow) -> bool:
    """True if unsafe runs with the full guard are caused by exogenous events, which no plan accounts for.

    This is so if safety is clearly higher for initial states without such events.
    """
    every, uneventful = (row.metric(FULL.name, name) for name in ("saved_starts", "quiet_safe_starts"))
    if every is None or uneventful is None:
        return False
    return float(every["mean"]) < min(float(uneventful["mean"]), MOST)


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
            help=f"Of {','.join(GUARDS)}; +0.2 or +auto behind one asks for a margin.",
        ),
    ] = ",".join(USUAL),
    options: DeploymentOptions = _OPTIONS,
    output: Output = _OUTPUT,
) -> None:
    """Simulate policies under model mismatch, disturbances and noise, without a guard and with several.

    Stored simulations are reused if run, world (simulated environment), guard and size are unchanged.
    """
    modes = [name for name in map(str.strip, guards.split(",")) if guard_of(name)]
    laid = tuple(name.strip() for name in scenarios.split(",")) if scenarios else SCENARIOS
    deployments = Deployments(ResultStore("disturbed", options.out), options)
    for folder in options.runs(runs):
        deployments.add(folder, laid, modes)
    publish_deployments("disturbed", deployments, output, section, table)
