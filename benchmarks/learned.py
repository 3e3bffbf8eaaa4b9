"""Training methods in the paper's comparison: one row for each benchmark, method and training time.

The policies are judged on held-out initial states, which are never used in training.
"""

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
from benchmarks.table import Columns, Table, listed, provenance, text_of
from benchmarks.training import (
    OUTDATED_TEXT,
    SeedGroup,
    benchmark_order,
    fewer_text,
    grouped,
    inputs_text,
    interval_over_seeds,
)
from stlc.registry import METHODS

TEXT = f"""\
`accuracy` is the mean over seeds with its 95 % interval over seeds and states (Student's t and Wilson, added
in quadrature), `share of feasible` that mean as a share of the known feasible states (in brackets that of the
worst seed). A slow policy is judged on the first of the held-out states only: their number stands behind its
accuracy, and its shares refer to them. `known feasible`
is the share of the same states for which some satisfying plan is known, a lower bound of the feasible share.
From those `proved infeasible` no plan exists, by the planner `milp` (traffic and reach_n_avoid, whose
encodings are exact). How many `steps` a budget pays for depends on the machine and on its load; the seeds
of a row may come from different machines, which the end of the section lists.
{OUTDATED_TEXT}"""


@dataclass(frozen=True, slots=True)
class LearnedRow:
    """Results of one method on one benchmark with one training time, over all seeds.

    Attributes:
        benchmark: name of the specification.
        method: name of the method.
        length: training time as text, such as `60 s`.
        seeds: seeds of the training runs, in order.
        accuracies: plan accuracy for each seed, on the same held-out initial states.
        interval: 95 % interval of the mean accuracy, over seeds and states.
        judged: number of held-out states on which the policy was judged, for each seed.
        held_out: number of held-out states that were requested. Slow policies are judged on the first only.
        known_shares: share of the judged states from which a satisfying plan is known, for each seed; empty
            before a search.
        requirements: name of a requirement -> share of plans that satisfy it, mean over seeds.
        seconds: training time, mean over seeds.
        steps: number of training steps for each seed.
        outdated: inputs that have changed since the training runs.
    """

    benchmark: str
    method: str
    length: str
    seeds: tuple[int, ...]
    accuracies: tuple[float, ...]
    interval: tuple[float, float]
    judged: tuple[int, ...]
    held_out: int
    known_shares: tuple[float, ...]
    requirements: Mapping[str, float]
    seconds: float
    steps: tuple[int, ...]
    outdated: tuple[str, ...] = ()

    @property
    def accuracy(self) -> float:
        """Mean of the plan accuracy over all seeds."""
        return fmean(self.accuracies)

    @property
    def known_feasible(self) -> float | None:
        """Mean of `known_shares` over all seeds; None before a search."""
        return fmean(self.known_shares) if self.known_shares else None

    @property
    def share(self) -> float | None:
        """Mean accuracy divided by `known_feasible`; None if that is unknown."""
        return self.accuracy / self.known_feasible if self.known_feasible else None

    @property
    def worst_share(self) -> float | None:
        """Smallest ratio of a seed's accuracy to its entry of `known_shares`; None if these are unknown."""
        pairs = zip(self.accuracies, self.known_shares, strict=False)
        return min((accuracy / known for accuracy, known in pairs if known), default=None)


def row_of(group: SeedGroup, known: Mapping[str, KnownFeasible]) -> LearnedRow:
    """Return the row with the mean results of `group`: training runs that differ only in the seed.

    `known` maps the name of a benchmark to the share of states from which a satisfying plan is known.
    """
    cell, results, judged = group.cell, group.results, group.judged
    found = known.get(cell.benchmark)
    return LearnedRow(
        *(cell.benchmark, cell.contender, cell.length.text, group.seeds, group.accuracies),
        interval=interval_over_seeds(group.accuracies, judged),
        judged=judged,
        held_out=cell.held_out,
        known_shares=() if found is None else tuple(map(found.share_among, judged)),
        requirements={
            name: fmean(each["requirements"][name] for each in results) for name in results[0]["requirements"]
        },
        seconds=group.mean("seconds"),
        steps=tuple(int(each["steps"]) for each in results),
        outdated=group.outdated,
    )


FIRST: Columns[LearnedRow] = {"benchmark": "{benchmark}", "method": "{method}", "budget": "{length}"}
SHOWN: Columns[LearnedRow] = {
    **FIRST,
    "seeds": lambda row: ", ".join(map(str, row.seeds)),
    "accuracy": lambda row: (
        text_of(row, "{accuracy:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]")
        + fewer_text(row.judged, row.held_out)
    ),
    "worst seed": lambda row: f"{min(row.accuracies):.4f}",
    "known feasible": "{known_feasible:.4f}",
    "share of feasible": lambda row: "" if row.share is None else f"{row.share:.3f} ({row.worst_share:.3f})",
    "steps": lambda row: " to ".join(f"{each:,}" for each in sorted({min(row.steps), max(row.steps)})),
    "inputs": lambda row: inputs_text(row.outdated),
}
REQUIREMENTS: Columns[LearnedRow] = {
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
    """Return two tables: the training results (`rows`), and the known feasible shares (`known_feasible`).

    The known feasible share of a benchmark is the share of states from which a satisfying plan is known.
    """
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
    """Return the lines of the page's subsection on training runs, and write its figure beside `page`."""
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
    """Return the accuracies of all training runs, one for each group of seeds; outdated ones come first."""
    rows = [row_of(group, {}) for group in grouped(results)]
    rows.sort(key=lambda row: not row.outdated)
    return [
        Learned(
            *(row.benchmark, row.method, row.length, row.accuracy, row.interval, row.seconds),
            seeds=row.seeds,
            outdated=bool(row.outdated),
            fewer=fewer_text(row.judged, row.held_out),
        )
        for row in rows
    ]
