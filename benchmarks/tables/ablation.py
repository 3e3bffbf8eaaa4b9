"""The paper's ablations of gamma, k, network size and number of samples on traffic, repeated.

Every row changes one of a set of defaults: gamma = 0.5, k = 500, a 256x3 network, 50,000 samples. The plain
gradient method trains on a fixed set of states, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import typer

from benchmarks.options import OnlyOption, Output, Training, chosen
from benchmarks.store import Result
from benchmarks.table import Table, provenance, show, write_section
from benchmarks.training import Cell, Length, filled, grouped
from stlc.cli.framework.program import command

BENCHMARK = "traffic"
BUDGETS = (60.0,)
TEXT = """\
Traffic, the plain gradient method on a fixed training set; one number at a time differs from gamma = 0.5,
k = 500, a network of 256x3 and 50,000 samples. Beside ours: the table of the paper, which trained for hours.
"""
_TRAINING, _OUTPUT = Training(), Output(Path("docs/results.md"))

Reported = Mapping[str, tuple[float, float]]
"""Value -> training and validation accuracy in the paper."""


@dataclass(frozen=True, slots=True)
class Axis:
    """A hyperparameter that is varied.

    Attributes:
        name: for options and files.
        title: for people.
        key: of the system file.
        default: value while another one is varied.
        reported: values and what the paper reports for them.
    """

    name: str
    title: str
    key: str
    default: str
    reported: Reported

    def setting(self, value: str) -> str:
        """`value` as `--set` takes it."""
        if self.name != "network":
            return value
        width, _, layers = value.partition("x")
        return "[" + ", ".join([width] * int(layers)) + "]"


AXES = (
    Axis(
        "gamma",
        "Truncation factor gamma",
        "objective.gamma",
        "0.5",
        {
            **{"0.0": (0.855, 0.788), "0.1": (0.920, 0.912), "0.2": (0.918, 0.915)},
            **{"0.5": (0.957, 0.957), "0.8": (0.957, 0.958), "1.0": (0.958, 0.955)},
        },
    ),
    Axis(
        "k",
        "Scaling factor k",
        "objective.smoothing",
        "500",
        {
            **{"1": (0.542, 0.542), "10": (0.950, 0.946), "100": (0.957, 0.957)},
            **{"1000": (0.958, 0.957), "10000": (0.956, 0.956)},
        },
    ),
    Axis(
        "network",
        "Network size (neurons x layers)",
        "policy.hidden",
        "256x3",
        {
            **{"32x2": (0.951, 0.954), "32x3": (0.951, 0.950), "64x2": (0.951, 0.951)},
            **{"64x3": (0.951, 0.956), "128x2": (0.954, 0.949), "128x3": (0.956, 0.952)},
            **{"256x2": (0.952, 0.951), "256x3": (0.957, 0.957)},
        },
    ),
    Axis(
        "samples",
        "Training samples N",
        "train.samples",
        "50000",
        {
            **{"200": (0.800, 0.663), "400": (0.755, 0.651), "800": (0.941, 0.836)},
            **{"1600": (0.947, 0.874), "3200": (0.952, 0.903), "6400": (0.962, 0.920)},
            **{"12800": (0.957, 0.942), "25600": (0.954, 0.953), "50000": (0.957, 0.957)},
        },
    ),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One value of a hyperparameter for one length, over all seeds.

    Attributes:
        axis: name of the hyperparameter.
        value: of it.
        length: such as `60 s`.
        seeds: how many.
        training: accuracy on the training states, mean over seeds.
        accuracies: on the held-out states, one a seed.
        reported: training and validation accuracy in the paper; None if it has no such row.
    """

    axis: str
    value: str
    length: str
    seeds: int
    training: float
    accuracies: tuple[float, ...]
    reported: tuple[float, float] | None

    @property
    def accuracy(self) -> float:
        """Mean over all seeds."""
        return fmean(self.accuracies)

    @property
    def spread(self) -> str:
        """Mean, and with several seeds minimum and maximum."""
        spread = f" ({min(self.accuracies):.3f} to {max(self.accuracies):.3f})" if self.seeds > 1 else ""
        return f"{self.accuracy:.3f}{spread}"


COLUMNS: dict[str, Callable[[Row], str]] = {
    "": lambda row: row.value,
    "budget": lambda row: row.length,
    "seeds": lambda row: str(row.seeds),
    "training": lambda row: f"{row.training:.3f}",
    "held out": lambda row: row.spread,
    "paper: training": lambda row: f"{row.reported[0]:.3f}" if row.reported else "",
    "paper: validation": lambda row: f"{row.reported[1]:.3f}" if row.reported else "",
}


def cells_of(axes: Sequence[str], trainings: Sequence[tuple[int, Length]], held_out: int) -> list[Cell]:
    """The trainings of the tables, shared ones once."""
    settings = [("base", "")]
    settings += [
        (axis.name, value)
        for axis in AXES
        if axis.name in axes
        for value in axis.reported
        if value != axis.default
    ]
    return [
        Cell(
            *(BENCHMARK, "gradient", seed, length, held_out, name, value),
            overrides={each.key: each.setting(value if each.name == name else each.default) for each in AXES},
        )
        for seed, length in trainings
        for name, value in settings
    ]


def table(results: Sequence[Result], axes: Sequence[str]) -> Table[Any, Row]:
    """The rows, axis by axis, each with the row of the defaults."""
    groups = grouped(results, lambda cell: (cell.axis, cell.value, cell.length.text))
    lengths = dict.fromkeys(length for _, _, length in groups)
    cells = []
    for axis in (each for each in AXES if each.name in axes):
        for value in sorted({*axis.reported, axis.default}, key=_order):
            name, found = ("base", "") if value == axis.default else (axis.name, value)
            cells += [
                (axis, value, length, groups[name, found, length])
                for length in lengths
                if (name, found, length) in groups
            ]
    return Table("ablation", cells, lambda cell: _row(*cell), COLUMNS)


def _order(value: str) -> tuple[float, float]:
    width, _, layers = value.partition("x")
    return float(width), float(layers or 0)


def _row(axis: Axis, value: str, length: str, own: Sequence[Result]) -> Row:
    return Row(
        *(axis.name, value, length, len(own)),
        training=fmean(float(each["training_accuracy"]) for each in own),
        accuracies=tuple(float(each["accuracy"]) for each in own),
        reported=axis.reported.get(value),
    )


def section(results: Sequence[Result]) -> list[str]:
    """The section of the page, without axes for which only the default is known."""
    lines = ["## Ablation", "", TEXT.rstrip()]
    for axis in AXES:
        made = table(results, [axis.name])
        if len({row.value for row in made.rows}) > 1:
            lines += ["", f"### {axis.title}", "", *made.markdown()]
    return [*lines, "", *provenance(results, "trainings")]


@command(
    "python -m benchmarks ablation", "python -m benchmarks ablation --only gamma,k --budget 60s --seeds 0"
)
def ablation(only: OnlyOption = None, training: Training = _TRAINING, output: Output = _OUTPUT) -> None:
    """Repeat the paper's tables for gamma, k, network size and number of samples on traffic.

    60 s if no budget is given. Stored results with the same inputs are reused; interrupted trainings are
    resumed. Exit code 1 if a training failed.
    """
    axes = chosen(only, [axis.name for axis in AXES], "table")
    place = training.place("ablation")
    filling = filled(cells_of(axes, training.seeds_and_lengths(BUDGETS), training.held_out), place)
    results, page = place.valid(), output.page or _OUTPUT.page
    assert page is not None
    write_section(page, "ablation", section(results))
    code = 1 if filling.failed else 0
    facts = {"page": str(page), "results": len(results), **filling.facts}
    made = table(filling.results, axes)
    shown = replace(made, columns={"axis": lambda row: row.axis, **COLUMNS})
    show("ablation", {"rows": shown}, as_json=output.as_json, code=code, **facts)
    raise typer.Exit(code)
