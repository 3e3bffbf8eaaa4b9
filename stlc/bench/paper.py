"""`stlc bench paper`: the six benchmarks of the paper, by both methods, over seeds and budgets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from stlc.bench.cells import BENCHMARKS, Cell, Length, length_of
from stlc.controller.training.config import HELD_OUT
from stlc.registry import METHODS

LENGTHS = (Length(60.0), Length(300.0))
SEEDS = (0, 1, 2)


@dataclass(frozen=True, slots=True)
class Extent:
    """Which part of a table is wanted.

    Attributes:
        benchmarks: names of specifications.
        methods: of training.
        seeds: of training.
        lengths: of training.
        held_out: states of the verdict.
    """

    benchmarks: Sequence[str] = BENCHMARKS
    methods: Sequence[str] = METHODS.names
    seeds: Sequence[int] = SEEDS
    lengths: Sequence[Length] = LENGTHS
    held_out: int = HELD_OUT


def paper_cells(extent: Extent) -> list[Cell]:
    """The cells of the table; short trainings and early seeds first, so that it fills evenly."""
    return [
        Cell(benchmark, method, seed, length, extent.held_out)
        for length in extent.lengths
        for seed in extent.seeds
        for benchmark in extent.benchmarks
        for method in extent.methods
    ]


@dataclass(frozen=True, slots=True)
class Row:
    """A benchmark by one method for one length, over all seeds.

    Attributes:
        benchmark: name.
        method: of training.
        length: such as `60 s`.
        seeds: in order.
        accuracies: one a seed, on the same held-out states.
        interval: 95 % Wilson interval of the mean, over the states of all seeds.
        ceiling: share of those states for which a satisfying plan is known; None before it was searched for.
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
    ceiling: float | None
    requirements: Mapping[str, float]
    seconds: float
    steps: float

    @property
    def mean(self) -> float:
        """Accuracy over all seeds."""
        return fmean(self.accuracies)

    @property
    def share(self) -> float | None:
        """Of the ceiling."""
        return self.mean / self.ceiling if self.ceiling else None

    @property
    def worst_share(self) -> float | None:
        """Of the ceiling, by the worst seed."""
        return min(self.accuracies) / self.ceiling if self.ceiling else None


def paper_rows(documents: Iterable[Mapping[str, Any]], ceilings: Mapping[str, float]) -> list[Row]:
    """The table of the results of cells: benchmarks in the paper's order, then methods, then lengths."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for document in documents:
        length = length_of(document).text
        key = (document["benchmark"], document["method"], length)
        groups.setdefault(key, []).append(document)
    rows = [_row(key, group, ceilings.get(key[0])) for key, group in groups.items()]
    return sorted(rows, key=_place)


def _place(row: Row) -> tuple[int, str, int, float]:
    known = BENCHMARKS.index(row.benchmark) if row.benchmark in BENCHMARKS else len(BENCHMARKS)
    return known, row.benchmark, METHODS.names.index(row.method), row.seconds


def _row(key: tuple[str, str, str], group: Sequence[Mapping[str, Any]], ceiling: float | None) -> Row:
    from stlc.controller.evaluation.held_out import wilson

    ordered = sorted(group, key=lambda document: int(document["seed"]))
    accuracies = tuple(float(document["accuracy"]) for document in ordered)
    names = ordered[0]["requirements"]
    return Row(
        *key,
        seeds=tuple(int(document["seed"]) for document in ordered),
        accuracies=accuracies,
        interval=wilson(fmean(accuracies), sum(int(document["held_out"]) for document in ordered)),
        ceiling=ceiling,
        requirements={name: fmean(document["requirements"][name] for document in ordered) for name in names},
        seconds=fmean(float(document["seconds"]) for document in ordered),
        steps=fmean(float(document["steps"]) for document in ordered),
    )
