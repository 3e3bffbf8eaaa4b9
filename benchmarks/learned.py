"""Learner rows of the paper's comparison: trainings over seeds and budgets, on held-out states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.comparison import Learned
from benchmarks.curves import PICTURE, draw_results
from benchmarks.feasible import KnownFeasible
from benchmarks.store import Result
from benchmarks.table import Columns, Table, listed, provenance
from benchmarks.training import OUTDATED_TEXT, SeedGroup, benchmark_order, grouped, inputs_text
from stlc.controller.evaluation.held_out import wilson
from stlc.registry import METHODS

TEXT = f"""\
`accuracy` is the mean over seeds with its 95 % Wilson interval, `share of feasible` that mean as a share of
the known feasible states (in brackets that of the worst seed). `known feasible` is the share of the same
states for which some satisfying plan is known, a lower bound of the feasible share. From those `proved
infeasible` no plan exists, by the planner `milp` (traffic and reach_n_avoid, whose encodings are exact).
{OUTDATED_TEXT}"""


@dataclass(frozen=True, slots=True)
class Row:
    """A benchmark by one method for one length, over all seeds.

    Attributes:
        benchmark: name.
        method: name of the contender.
        length: such as `60 s`.
        seeds: of the trainings, in order.
        accuracies: one per seed, on the same held-out states.
        interval: 95 % Wilson interval of the mean, over the states of all seeds.
        known_feasible: share of those states with a known satisfying plan; None before a search.
        requirements: share per requirement, mean over seeds.
        seconds: of training, mean over seeds.
        steps: mean over seeds.
        outdated: inputs that have changed since the trainings.
    """

    benchmark: str
    method: str
    length: str
    seeds: tuple[int, ...]
    accuracies: tuple[float, ...]
    interval: tuple[float, float]
    known_feasible: float | None
    requirements: Mapping[str, float]
    seconds: float
    steps: float
    outdated: tuple[str, ...] = ()

    @property
    def accuracy(self) -> float:
        """Mean over all seeds."""
        return fmean(self.accuracies)

    @property
    def share(self) -> float | None:
        """Accuracy over the known feasible states."""
        return self.accuracy / self.known_feasible if self.known_feasible else None

    @property
    def worst_share(self) -> float | None:
        """Accuracy of the worst seed over the known feasible states."""
        return min(self.accuracies) / self.known_feasible if self.known_feasible else None


def row_of(group: SeedGroup, known: Mapping[str, KnownFeasible]) -> Row:
    """The row of the results of a benchmark, method and length."""
    cell, results = group.cell, group.results
    found = known.get(cell.benchmark)
    return Row(
        *(cell.benchmark, cell.contender, cell.length.text, group.seeds, group.accuracies),
        interval=wilson(group.mean("accuracy"), sum(int(each["key"]["held_out"]) for each in results)),
        known_feasible=None if found is None else found.share,
        requirements={
            name: fmean(each["requirements"][name] for each in results) for name in results[0]["requirements"]
        },
        seconds=group.mean("seconds"),
        steps=group.mean("steps"),
        outdated=group.outdated,
    )


FIRST: Columns[Row] = {"benchmark": "{benchmark}", "method": "{method}", "budget": "{length}"}
SHOWN: Columns[Row] = {
    **FIRST,
    "seeds": lambda row: ", ".join(map(str, row.seeds)),
    "accuracy": "{accuracy:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]",
    "worst seed": lambda row: f"{min(row.accuracies):.4f}",
    "known feasible": "{known_feasible:.4f}",
    "share of feasible": lambda row: "" if row.share is None else f"{row.share:.3f} ({row.worst_share:.3f})",
    "steps": "{steps:,.0f}",
    "inputs": lambda row: inputs_text(row.outdated),
}
REQUIREMENTS: Columns[Row] = {
    **FIRST,
    "requirements": lambda row: ", ".join(f"{name} {share:.4f}" for name, share in row.requirements.items()),
}
FEASIBLE: Columns[KnownFeasible] = {
    "benchmark": "{benchmark}",
    "known feasible": "{share:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]",
    "no plan known": "{open:,}",
    "proved infeasible": lambda row: "" if row.proved is None else f"{row.proved:,}",
    "by search alone": "{by_search:,}",
    "plans tried a state": "{tries:,}",
}


def tables(results: Sequence[Result], known: Mapping[str, KnownFeasible]) -> dict[str, Table[Any, Any]]:
    """The table of benchmarks, methods and lengths, and that of the known feasible shares."""
    groups = sorted(
        grouped(results),
        key=lambda group: (
            *benchmark_order(group.cell.benchmark),
            _place(group.cell.method),
            group.cell.contender,
            group.mean("seconds"),
        ),
    )
    names = dict.fromkeys(group.cell.benchmark for group in groups)
    return {
        "rows": Table("paper", groups, lambda group: row_of(group, known), SHOWN),
        "known_feasible": listed("known", [known[name] for name in names if name in known], FEASIBLE),
    }


def detailed(results: Sequence[Result], known: Mapping[str, KnownFeasible], page: Path) -> list[str]:
    """Subsection on the trainings; its picture is written into the page's folder."""
    made = tables(results, known)
    rows = made["rows"].rows
    names = dict.fromkeys(row.benchmark for row in rows)
    drawn = draw_results(results, {name: known.get(name) for name in names}, page.parent / PICTURE)
    return [
        *("### Trainings", ""),
        *((f"![Plan accuracy over training time]({PICTURE})", "") if drawn else ()),
        *(*made["rows"].markdown(), "", TEXT, *made["known_feasible"].markdown(), ""),
        *("### Requirements", "", "Share of the held-out states per requirement, mean over seeds.", ""),
        *(*listed("requirements", rows, REQUIREMENTS).markdown(), "", *provenance(results, "trainings")),
    ]


def _place(method: str) -> int:
    return METHODS.names.index(method) if method in METHODS.names else len(METHODS.names)


def learned(results: Sequence[Result]) -> list[Learned]:
    """The accuracies of all trainings, outdated ones first."""
    rows = [row_of(group, {}) for group in grouped(results)]
    rows.sort(key=lambda row: not row.outdated)
    return [
        Learned(
            *(row.benchmark, row.method, row.length, row.accuracy, row.interval, row.seconds),
            outdated=bool(row.outdated),
        )
        for row in rows
    ]
