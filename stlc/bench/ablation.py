"""`stlc bench ablation`: what the paper varies on traffic, and what it reports.

Every row changes one number of one set of defaults: gamma = 0.5, k = 500, a 256x3 network, 50,000 samples.
The plain gradient method trains on a fixed set of states, as in the paper.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from stlc.bench.cells import Cell, Length, length_of
from stlc.controller.training.config import HELD_OUT

BENCHMARK = "traffic"
LENGTHS = (Length(60.0),)

Reported = Mapping[str, tuple[float, float]]
"""Value -> accuracy on training and on validation states, as the paper has them."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One number that is varied.

    Attributes:
        name: for options and files.
        title: for people.
        key: of the system file.
        default: where it stands while another one is varied.
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
class Extent:
    """Which part of the tables is wanted.

    Attributes:
        axes: names.
        seeds: of training.
        lengths: of training.
        held_out: states of the verdict.
    """

    axes: Sequence[str] = tuple(axis.name for axis in AXES)
    seeds: Sequence[int] = (0, 1, 2)
    lengths: Sequence[Length] = LENGTHS
    held_out: int = HELD_OUT


def ablation_cells(extent: Extent) -> list[Cell]:
    """The cells of the tables; what several tables have in common is one cell."""
    settings = [("base", "", "")]
    for axis in AXES:
        if axis.name in extent.axes:
            settings += [(axis.name, axis.key, value) for value in axis.reported if value != axis.default]
    return [
        _cell(setting, seed, length, extent.held_out)
        for length in extent.lengths
        for seed in extent.seeds
        for setting in settings
    ]


def _cell(setting: tuple[str, str, str], seed: int, length: Length, held_out: int) -> Cell:
    name, _, value = setting
    overrides = {axis.key: axis.setting(value if axis.name == name else axis.default) for axis in AXES}
    return Cell(BENCHMARK, "gradient", seed, length, held_out, axis=name, value=value, overrides=overrides)


@dataclass(frozen=True, slots=True)
class Row:
    """One value of one axis for one length, over all seeds.

    Attributes:
        axis: name.
        value: of it.
        length: such as `60 s`.
        seeds: how many.
        training: accuracy on the training states, mean over seeds.
        accuracies: on the held-out states, one a seed.
        reported: training and validation accuracy in the paper; None where it has no such row.
    """

    axis: str
    value: str
    length: str
    seeds: int
    training: float
    accuracies: tuple[float, ...]
    reported: tuple[float, float] | None

    @property
    def mean(self) -> float:
        """Accuracy over all seeds."""
        return fmean(self.accuracies)


def ablation_rows(documents: Iterable[Mapping[str, Any]]) -> list[Row]:
    """The tables one after the other, each with the defaults in their place."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for document in documents:
        length = length_of(document).text
        groups.setdefault((document["axis"], document["value"], length), []).append(document)
    lengths = dict.fromkeys(length for _, _, length in groups)
    rows = []
    for axis in AXES:
        values = [*axis.reported, *([] if axis.default in axis.reported else [axis.default])]
        for value in sorted(values, key=_order):
            for length in lengths:
                name, found = ("base", "") if value == axis.default else (axis.name, value)
                if group := groups.get((name, found, length)):
                    rows.append(_row(axis, value, length, group))
    return rows


def _order(value: str) -> tuple[float, float]:
    width, _, layers = value.partition("x")
    return float(width), float(layers or 0)


def _row(axis: Axis, value: str, length: str, group: Sequence[Mapping[str, Any]]) -> Row:
    return Row(
        axis.name,
        value,
        length,
        seeds=len(group),
        training=fmean(float(document["training_accuracy"]) for document in group),
        accuracies=tuple(float(document["accuracy"]) for document in group),
        reported=axis.reported.get(value),
    )
