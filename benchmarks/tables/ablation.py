"""The paper's ablations on traffic, repeated: gamma, k, network size and number of training samples.

In every row, one of these numbers differs from its default: gamma = 0.5, k = 500, a network of 3 layers with
256 neurons, 50,000 samples. As in the paper, the plain gradient method trains on a fixed set of initial
states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.options import OnlyOption, Output, Training, chosen
from benchmarks.store import Result
from benchmarks.table import Columns, Table, provenance, publish
from benchmarks.training import OUTDATED_TEXT, Cell, Length, SeedGroup, filled, grouped, inputs_text
from stlc.cli.framework.program import command

BENCHMARK = "traffic"
BUDGETS = (60.0,)
TEXT = f"""\
Traffic, the plain gradient method on a fixed training set; one number at a time differs from gamma = 0.5,
k = 500, a network of 256x3 and 50,000 samples. Beside ours: the table of the paper, which trained for hours.
{OUTDATED_TEXT}"""
_TRAINING, _OUTPUT = Training(), Output(Path("docs/results.md"))


@dataclass(frozen=True, slots=True)
class Axis:
    """A hyperparameter that the ablation varies.

    Attributes:
        name: name in options and files.
        title: heading of its table.
        key: name of the hyperparameter in the system file.
        default: value while another hyperparameter is varied.
        table: accuracies that the paper reports, as a text of entries `VALUE TRAINING VALIDATION` with commas
            between them.
    """

    name: str
    title: str
    key: str
    default: str
    table: str

    @property
    def reported(self) -> dict[str, tuple[float, float]]:
        """Accuracies in the paper: value of the hyperparameter -> (training, validation) accuracy."""
        rows = (row.split() for row in self.table.split(","))
        return {value: (float(training), float(validation)) for value, training, validation in rows}

    def setting(self, value: str) -> str:
        """Return `value` in the notation of the option `--set`: `256x3` becomes `[256, 256, 256]`."""
        width, _, layers = value.partition("x")
        return "[" + ", ".join([width] * int(layers)) + "]" if layers else value


AXES = (
    Axis(
        *("gamma", "Truncation factor gamma", "objective.gamma", "0.5"),
        "0.0 .855 .788, 0.1 .920 .912, 0.2 .918 .915, 0.5 .957 .957, 0.8 .957 .958, 1.0 .958 .955",
    ),
    Axis(
        *("k", "Scaling factor k", "objective.smoothing", "500"),
        "1 .542 .542, 10 .950 .946, 100 .957 .957, 1000 .958 .957, 10000 .956 .956",
    ),
    Axis(
        *("network", "Network size (neurons x layers)", "policy.hidden", "256x3"),
        "32x2 .951 .954, 32x3 .951 .950, 64x2 .951 .951, 64x3 .951 .956, "
        "128x2 .954 .949, 128x3 .956 .952, 256x2 .952 .951, 256x3 .957 .957",
    ),
    Axis(
        *("samples", "Training samples N", "train.samples", "50000"),
        "200 .800 .663, 400 .755 .651, 800 .941 .836, 1600 .947 .874, 3200 .952 .903, "
        "6400 .962 .920, 12800 .957 .942, 25600 .954 .953, 50000 .957 .957",
    ),
)


@dataclass(frozen=True, slots=True)
class AblationRow:
    """Results for one value of a hyperparameter and one training time, over all seeds.

    Attributes:
        axis: name of the hyperparameter.
        value: value of the hyperparameter.
        length: training time as text, such as `60 s`.
        seeds: number of training runs.
        training: accuracy on the training states, mean over seeds.
        accuracies: accuracy for each seed on held-out states, which are never used in training.
        reported: training and validation accuracy in the paper; None if the paper has no such row.
        outdated: inputs that have changed since the training runs.
    """

    axis: str
    value: str
    length: str
    seeds: int
    training: float
    accuracies: tuple[float, ...]
    reported: tuple[float, float] | None
    outdated: tuple[str, ...] = ()

    @property
    def accuracy(self) -> float:
        """Mean of the accuracy on held-out states over all seeds."""
        return fmean(self.accuracies)

    @property
    def spread(self) -> str:
        """Mean of the accuracy as text; with several seeds, minimum and maximum follow."""
        spread = f" ({min(self.accuracies):.3f} to {max(self.accuracies):.3f})" if self.seeds > 1 else ""
        return f"{self.accuracy:.3f}{spread}"


COLUMNS: Columns[AblationRow] = {
    **{"": "{value}", "budget": "{length}", "seeds": "{seeds}", "training": "{training:.3f}"},
    "held out": "{spread}",
    "paper: training": lambda row: f"{row.reported[0]:.3f}" if row.reported else "",
    "paper: validation": lambda row: f"{row.reported[1]:.3f}" if row.reported else "",
    "inputs": lambda row: inputs_text(row.outdated),
}


def cells_of(axes: Sequence[str], trainings: Sequence[tuple[int, Length]], held_out: int) -> list[Cell]:
    """Return the training runs of the tables; a run that several tables show is listed once.

    Args:
        axes: names of the hyperparameters to vary.
        trainings: (seed, length) pairs.
        held_out: number of held-out states.
    """
    chosen_axes = [axis for axis in AXES if axis.name in axes]
    varied = [(axis.name, value) for axis in chosen_axes for value in axis.reported if value != axis.default]
    return [
        Cell(
            *(BENCHMARK, "gradient", seed, length, held_out, name, value),
            overrides={each.key: each.setting(value if each.name == name else each.default) for each in AXES},
        )
        for seed, length in trainings
        for name, value in [("base", ""), *varied]
    ]


def table(results: Sequence[Result], axes: Sequence[str]) -> Table[Any, AblationRow]:
    """Return the table of the hyperparameters `axes`: a row for each value, including the default value."""
    groups = grouped(results)
    cells = [
        (axis, value, group)
        for axis in AXES
        if axis.name in axes
        for value in sorted({*axis.reported, axis.default}, key=lambda value: [*map(float, value.split("x"))])
        for group in groups
        if (group.cell.axis, group.cell.value)
        == (("base", "") if value == axis.default else (axis.name, value))
    ]
    return Table("ablation", cells, lambda cell: _row(*cell), COLUMNS)


def _row(axis: Axis, value: str, group: SeedGroup) -> AblationRow:
    return AblationRow(
        *(axis.name, value, group.cell.length.text, len(group.seeds), group.mean("training_accuracy")),
        *(group.accuracies, axis.reported.get(value), group.outdated),
    )


def section(results: Sequence[Result]) -> list[str]:
    """Return the lines of the page's section, one table per hyperparameter.

    A hyperparameter is left out if only its default value was measured.
    """
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

    The training time is 60 s if no budget is given. Stored results with the same inputs are reused.
    Interrupted training runs are resumed. Exit code: 0, or 1 if a training run failed.
    """
    axes = chosen(only, [axis.name for axis in AXES], "table")
    place = training.place("ablation")
    filling = filled(cells_of(axes, training.seeds_and_lengths(BUDGETS), training.held_out), place)
    made = table(filling.results, axes)
    shown = {"rows": replace(made, columns={"axis": "{axis}", **COLUMNS})}
    publish("ablation", output, lambda: section(place.all()), shown, **filling.facts(len(place.valid())))
