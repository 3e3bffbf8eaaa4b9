"""One policy for all values of a parameter, validated at values inside and outside its training range.

A family is a specification in `specs/families/`. It equals a benchmark's specification, except that one
constant is a parameter (`param`). Its policy is trained once, on values drawn from the declared range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.options import OnlyOption, Output, Training, chosen
from benchmarks.store import Key, Result, ResultStore, load
from benchmarks.table import Columns, Table, provenance, publish
from benchmarks.training import (
    OUTDATED_TEXT,
    Cell,
    Place,
    SeedGroup,
    filled,
    grouped,
    inputs_text,
    interval_over_seeds,
)
from stlc.cli.framework.output import say
from stlc.cli.framework.program import command
from stlc.controller.evaluation.held_out import score
from stlc.controller.run.run import Run

BUDGETS = (60.0,)
TEXT = f"""\
Specifications in `specs/families/`, each that of a benchmark with one constant made a `param`. A policy is
trained once, on values drawn evenly from the range in the title, and judged at single values; those outside
of the range are in italics. `known feasible` is the share of the same states for which a satisfying plan is
known, the policy's own or one that a search has found, and `share of feasible` the accuracy as a share of
that.
{OUTDATED_TEXT}"""
_TRAINING = Training(seeds="0", held_out=2000)
_OUTPUT = Output(Path("docs/results.md"))


@dataclass(frozen=True, slots=True)
class Family:
    """A specification with one parameter, and the values at which its policy is validated.

    Attributes:
        name: name of the specification in `specs/families/`.
        parameter: name of the parameter.
        unit: unit of the parameter and of `values`.
        title: description of the parameter.
        values: values in ascending order, some inside and some outside the training range.
    """

    name: str
    parameter: str
    unit: str
    title: str
    values: tuple[float, ...]

    def sampled(self) -> tuple[float, float]:
        """Return the (low, high) range from which training draws values, as the specification declares it."""
        (each,) = load(self.name).compiled.parameters
        assert each.column.low is not None
        assert each.column.high is not None
        return each.column.low, each.column.high


FAMILIES = (
    Family(
        *("ship_radius", "radius", "m", "ship-safe, the radius of the obstacles"),
        (0.4, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4),
    ),
    Family(
        *("stop_time", "stop_time", "s", "traffic, how long to stand at a stop sign"),
        (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0),
    ),
)


@dataclass(frozen=True, slots=True)
class FamilyRow:
    """Results of a family at one value of its parameter and one training time, over all seeds.

    Attributes:
        family: name of the specification.
        value: value of the parameter, in the unit of the family.
        inside: whether the value lies in the training range.
        length: training time as text, such as `60 s`.
        seeds: seeds of the training runs.
        accuracy: plan accuracy, mean over seeds.
        interval: 95 % interval of the accuracy, over seeds and states.
        feasible: share of the states from which a satisfying plan is known, mean over seeds.
        outdated: inputs that have changed since the training runs.
    """

    family: str
    value: float
    inside: bool
    length: str
    seeds: tuple[int, ...]
    accuracy: float
    interval: tuple[float, float]
    feasible: float
    outdated: tuple[str, ...] = ()

    @property
    def share(self) -> float | None:
        """Accuracy divided by `feasible`; None if `feasible` is 0."""
        return self.accuracy / self.feasible if self.feasible else None


COLUMNS: Columns[FamilyRow] = {
    "value": lambda row: f"{row.value:g} {_named(row.family).unit}".join(("", "") if row.inside else "**"),
    "budget": "{length}",
    "seeds": lambda row: ", ".join(map(str, row.seeds)),
    "accuracy": "{accuracy:.4f} [{interval[0]:.4f}, {interval[1]:.4f}]",
    "known feasible": "{feasible:.4f}",
    "share of feasible": "{share:.3f}",
    "inputs": lambda row: inputs_text(row.outdated),
}


def _named(name: str) -> Family:
    return next(family for family in FAMILIES if family.name == name)


def key_of(training: Result, value: float) -> Key:
    """Return the key under which the validation of a trained policy at one parameter value is stored.

    `training` is the stored result of the training run.
    """
    values = {"training": training["key"], "trained": training["made"]["date"], "value": value}
    return Key(f"{training['name']} at {value:g}", values)


def judge_all(trainings: Sequence[Result], place: Place, verdicts: ResultStore) -> list[dict[str, str]]:
    """Validate trained policies at all values for which no result is stored.

    Args:
        trainings: stored results of the training runs.
        place: folder of the training runs.
        verdicts: file of the validation results.

    Returns:
        Name and reason of each training run whose policy is no longer available.
    """
    failed = []
    for training in trainings:
        cell = Cell.of(training)
        family, run = _named(cell.benchmark), place.newest_run(cell.key)
        missing = [value for value in family.values if verdicts.find(key_of(training, value)) is None]
        if missing and run is None:
            why = f"its run is gone: remove it from {place.store.path} to train anew"
            say(f"{cell.name}: {why}")
            failed.append({"name": cell.name, "why": why})
            continue
        for value in missing:
            assert run is not None
            say(f"judging {cell.name} at {family.parameter} = {value:g} {family.unit}")
            verdicts.put(key_of(training, value), _verdict(run.path, family, value, cell.held_out))
    return failed


def _verdict(run: Path, family: Family, value: float, held_out: int) -> Mapping[str, Any]:
    """Return the held-out accuracy of the policy in the folder `run`, for one value of the parameter."""
    opened = Run.open(run, overrides={family.parameter: f"{value}{family.unit}"})
    return score(opened.task, opened.policy, n=held_out).summary()


def table(trainings: Sequence[Result], verdicts: ResultStore) -> Table[Any, FamilyRow]:
    """Return the table, with rows ordered by family, training time and value."""
    cells = [
        (family, value, group, found)
        for group in sorted(grouped(trainings), key=lambda group: group.cell.length.text)
        for family in [_named(group.cell.benchmark)]
        for value in family.values
        if (found := [each for own in group.results if (each := verdicts.find(key_of(own, value)))])
    ]
    cells.sort(key=lambda cell: FAMILIES.index(cell[0]))
    return Table("family", cells, lambda cell: _row(*cell), COLUMNS)


def _row(family: Family, value: float, group: SeedGroup, verdicts: Sequence[Result]) -> FamilyRow:
    low, high = family.sampled()
    accuracies = [float(each["accuracy"]) for each in verdicts]
    return FamilyRow(
        *(family.name, value, low <= value <= high, group.cell.length.text),
        tuple(int(each["key"]["training"]["seed"]) for each in verdicts),
        fmean(accuracies),
        interval_over_seeds(accuracies, [int(each["held_out"]) for each in verdicts]),
        fmean(float(each["feasible"]) for each in verdicts),
        group.outdated,
    )


def section(trainings: Sequence[Result], made: Table[Any, FamilyRow]) -> list[str]:
    """Return the lines of the page's section, which has one table per family."""
    lines = ["## One policy for a family", "", TEXT.rstrip()]
    for family in FAMILIES:
        if own := [row for row in made.rows if row.family == family.name]:
            low, high = family.sampled()
            title = family.title[0].upper() + family.title[1:]
            lines += ["", f"### {title}, trained on {low:g} to {high:g} {family.unit}", ""]
            renamed = {
                f"`{family.parameter}`" if name == "value" else name: each for name, each in COLUMNS.items()
            }
            lines += replace(made, columns=renamed).markdown(own)
    return [*lines, "", *provenance(trainings, "trainings")]


@command(
    "python -m benchmarks family",
    "python -m benchmarks family --only stop_time --budget 60s --seeds 0..2 --jobs 2",
)
def family(only: OnlyOption = None, training: Training = _TRAINING, output: Output = _OUTPUT) -> None:
    """Train one policy for all values of a parameter, and validate it inside and outside its range.

    The training time is 60 s if no budget is given. Stored results with the same inputs are reused.
    Interrupted training runs are resumed. Exit code: 0, or 1 if a training run failed.
    """
    names = chosen(only, [each.name for each in FAMILIES], "family")
    cells = [
        Cell(name, "guided", seed, length, training.held_out)
        for seed, length in training.seeds_and_lengths(BUDGETS)
        for name in names
    ]
    place, verdicts = training.place("family"), ResultStore("family_verdicts", training.out)
    filling = filled(cells, place)
    failed = judge_all(filling.results, place, verdicts)
    made = table(filling.results, verdicts)
    shown = {"rows": replace(made, columns={"family": "{family}", **COLUMNS})}
    facts = filling.facts(len(place.valid()), failed)
    publish("family", output, lambda: section(place.all(), table(place.all(), verdicts)), shown, **facts)
