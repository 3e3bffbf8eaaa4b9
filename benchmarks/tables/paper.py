"""The six benchmarks of the paper, by both methods, over seeds and budgets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import typer

from benchmarks.curves import Panel, curve_of, draw_benchmarks
from benchmarks.feasible import KnownFeasible, known_feasible, search_on
from benchmarks.options import OnlyOption, Output, Training, chosen
from benchmarks.store import BENCHMARKS, Result, ResultStore
from benchmarks.table import Table, provenance, show, write_section
from benchmarks.training import Cell, benchmark_order, filled, grouped
from stlc.cli.framework.program import command
from stlc.controller.evaluation.held_out import wilson
from stlc.files import write_atomic
from stlc.registry import METHODS
from stlc.view import available

BUDGETS = (60.0, 300.0)
PICTURE = "img/results.svg"
COLUMNS = """\
`accuracy` is the mean over seeds with its 95 % Wilson interval, `share of feasible` that mean as a share of
the known feasible states (in brackets that of the worst seed). `known feasible` is the share of the same
states for which some satisfying plan is known, a lower bound of what is feasible:
"""
_TRAINING, _OUTPUT = Training(), Output(Path("docs/results.md"))


@dataclass(frozen=True, slots=True)
class Row:
    """A benchmark by one method for one length, over all seeds.

    Attributes:
        benchmark: name.
        method: of training.
        length: such as `60 s`.
        seeds: in order.
        accuracies: one per seed, on the same held-out states.
        interval: 95 % Wilson interval of the mean, over the states of all seeds.
        known_feasible: share of those states with a known satisfying plan; None before a search.
        requirements: share per requirement, mean over seeds.
        seconds: of training, mean over seeds.
        steps: mean over seeds.
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


def row_of(own: Sequence[Result], known: Mapping[str, KnownFeasible]) -> Row:
    """The row of the results of a benchmark, method and length."""
    cell, accuracies = Cell.of(own[0]), tuple(float(each["accuracy"]) for each in own)
    found = known.get(cell.benchmark)
    return Row(
        *(cell.benchmark, cell.method, cell.length.text),
        seeds=tuple(int(each["key"]["seed"]) for each in own),
        accuracies=accuracies,
        interval=wilson(fmean(accuracies), sum(int(each["key"]["held_out"]) for each in own)),
        known_feasible=None if found is None else found.share,
        requirements={
            name: fmean(each["requirements"][name] for each in own) for name in own[0]["requirements"]
        },
        seconds=fmean(float(each["seconds"]) for each in own),
        steps=fmean(float(each["steps"]) for each in own),
    )


FIRST: dict[str, Callable[[Row], str]] = {
    "benchmark": lambda row: row.benchmark,
    "method": lambda row: row.method,
    "budget": lambda row: row.length,
}
SHOWN: dict[str, Callable[[Row], str]] = {
    **FIRST,
    "seeds": lambda row: ", ".join(map(str, row.seeds)),
    "accuracy": lambda row: f"{row.accuracy:.4f} [{row.interval[0]:.4f}, {row.interval[1]:.4f}]",
    "worst seed": lambda row: f"{min(row.accuracies):.4f}",
    "known feasible": lambda row: "" if row.known_feasible is None else f"{row.known_feasible:.4f}",
    "share of feasible": lambda row: "" if row.share is None else f"{row.share:.3f} ({row.worst_share:.3f})",
    "steps": lambda row: f"{row.steps:,.0f}",
}
REQUIREMENTS: dict[str, Callable[[Row], str]] = {
    **FIRST,
    "requirements": lambda row: ", ".join(f"{name} {share:.4f}" for name, share in row.requirements.items()),
}
FEASIBLE: dict[str, Callable[[KnownFeasible], str]] = {
    "benchmark": lambda known: known.benchmark,
    "known feasible": lambda known: f"{known.share:.4f} [{known.interval[0]:.4f}, {known.interval[1]:.4f}]",
    "no plan known": lambda known: f"{known.open:,}",
    "by search alone": lambda known: f"{known.by_search:,}",
    "plans tried a state": lambda known: f"{known.tries:,}",
}


def tables(results: Sequence[Result], known: Mapping[str, KnownFeasible]) -> dict[str, Table[Any, Any]]:
    """The table of benchmarks, methods and lengths, and that of the known feasible shares."""
    groups = grouped(results, lambda cell: (cell.benchmark, cell.method, cell.length.text))
    ordered = sorted(
        groups.values(),
        key=lambda own: (
            *benchmark_order(own[0]["key"]["benchmark"]),
            METHODS.names.index(own[0]["key"]["method"]),
            fmean(float(each["seconds"]) for each in own),
        ),
    )
    names = dict.fromkeys(own[0]["key"]["benchmark"] for own in ordered)
    feasible = [known[name] for name in names if name in known]
    return {
        "rows": Table("paper", ordered, lambda own: row_of(own, known), SHOWN),
        "known_feasible": Table("known feasible", feasible, lambda each: each, FEASIBLE),
    }


def section(results: Sequence[Result], known: Mapping[str, KnownFeasible], *, picture: bool) -> list[str]:
    """The section of the page."""
    made = tables(results, known)
    requirements = Table("requirements", made["rows"].rows, lambda row: row, REQUIREMENTS)
    return [
        *("## The six benchmarks", ""),
        *((f"![Plan accuracy over training time]({PICTURE})", "") if picture else ()),
        *(*made["rows"].markdown(), "", COLUMNS, *made["known_feasible"].markdown(), ""),
        *("### Requirements", "", "Share of the held-out states per requirement, mean over seeds.", ""),
        *(*requirements.markdown(), "", *provenance(results, "trainings")),
    ]


def draw(results: Sequence[Result], known: Mapping[str, KnownFeasible], folder: Path) -> bool:
    """Draw accuracy over time of the longest trainings into the page's folder; False without matplotlib."""
    longest: dict[str, dict[tuple[str, int], Result]] = {}
    for each in sorted(results, key=lambda each: float(each["seconds"])):
        key = each["key"]
        longest.setdefault(key["benchmark"], {})[key["method"], key["seed"]] = each
    panels = [
        Panel(
            name, tuple(map(curve_of, longest[name].values())), known[name].share if name in known else None
        )
        for name in dict.fromkeys(row.benchmark for row in tables(results, known)["rows"].rows)
    ]
    picture = draw_benchmarks(panels) if available() else None
    if picture is not None:
        write_atomic(folder / PICTURE, picture.svg())
    return picture is not None


@command(
    "python -m benchmarks paper",
    "python -m benchmarks paper --only traffic,ship_safe --budget 60s --seeds 0 --jobs 2",
)
def paper(
    only: OnlyOption = None,
    methods: Annotated[
        str | None, typer.Option("--methods", metavar="NAMES", help="guided,gradient if not given.")
    ] = None,
    passes: Annotated[
        int,
        typer.Option(
            "--passes", metavar="N", min=0, help="Searches for feasible states, 20,000 plans a state each."
        ),
    ] = 10,
    training: Training = _TRAINING,
    output: Output = _OUTPUT,
) -> None:
    """Train and validate the six benchmarks of the paper, and write the tables and curves.

    60 s and 300 s if no budget is given. Stored results with the same inputs are reused; interrupted
    trainings are resumed. Exit code 1 if a training failed.
    """
    names = chosen(only, BENCHMARKS, "benchmark")
    which = [method for method in METHODS.names if method in chosen(methods, METHODS.names, "method")]
    cells = [
        Cell(benchmark, method, seed, length, training.held_out)
        for seed, length in training.seeds_and_lengths(BUDGETS)
        for benchmark in names
        for method in which
    ]
    place, found = training.place("paper"), ResultStore("feasible", training.out)
    filling = filled(cells, place)
    results = place.valid()
    for name in names:
        own = [each for each in results if each["key"]["benchmark"] == name]
        own = [each for each in own if each["key"]["held_out"] == training.held_out]
        if own:
            search_on(own, found, passes=passes, run=place.best_run(own))
    known = known_feasible(found, results)
    page = output.page or _OUTPUT.page
    assert page is not None
    write_section(page, "paper", section(results, known, picture=draw(results, known, page.parent)))
    code = 1 if filling.failed else 0
    facts = {"page": str(page), "results": len(results), **filling.facts}
    show("paper", tables(filling.results, known), as_json=output.as_json, code=code, **facts)
    raise typer.Exit(code)
