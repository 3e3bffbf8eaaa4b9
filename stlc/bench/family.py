"""`stlc bench family`: one policy for all values of a parameter, judged at single values of it.

A family is a specification in `specs/families/`: that of a benchmark with one constant made a `param`. A
policy is trained once, on values drawn from the declared range, and judged at values in it and outside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from stlc.bench.cells import Cell, Inputs, Length, inputs_of, load, read_json
from stlc.bench.study import Place, newest_run
from stlc.files import write_atomic
from stlc.jsontext import dumps
from stlc.provenance import git_state, hardware, versions
from stlc.rundir import RunDir, now

FORMAT = "bench-family/1"
FILE = "family.json"
LENGTHS = (Length(60.0),)
HELD_OUT = 2000
"""States of the verdict at each value."""


@dataclass(frozen=True, slots=True)
class Family:
    """A specification with one parameter, and where its policy is judged.

    Attributes:
        name: of the specification in `specs/families/`.
        parameter: its name.
        unit: of the parameter and of `values`.
        title: what is varied, for people.
        values: in order, some inside of the range that is trained on and some outside.
    """

    name: str
    parameter: str
    unit: str
    title: str
    values: tuple[float, ...]

    def sampled(self) -> tuple[float, float]:
        """The range that training draws from, as the specification declares it."""
        (each,) = load(self.name).compiled.parameters
        assert each.column.low is not None
        assert each.column.high is not None
        return each.column.low, each.column.high


FAMILIES = (
    Family(
        "ship_radius",
        "radius",
        "m",
        "ship-safe, the radius of the obstacles",
        (0.4, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4),
    ),
    Family(
        "stop_time",
        "stop_time",
        "s",
        "traffic, how long to stand at a stop sign",
        (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0),
    ),
)


@dataclass(frozen=True, slots=True)
class Extent:
    """Which part of the table is wanted.

    Attributes:
        families: which.
        seeds: of training.
        lengths: of training.
        held_out: states of the verdict at each value.
    """

    families: Sequence[Family] = FAMILIES
    seeds: Sequence[int] = (0,)
    lengths: Sequence[Length] = LENGTHS
    held_out: int = HELD_OUT


def family_cells(extent: Extent) -> list[Cell]:
    """The trainings behind the table."""
    return [
        Cell(family.name, "guided", seed, length, extent.held_out)
        for length in extent.lengths
        for seed in extent.seeds
        for family in extent.families
    ]


def family_of(cell: Cell) -> Family:
    """The family that a cell is a training of."""
    return next(family for family in FAMILIES if family.name == cell.benchmark)


def judge(
    cell: Cell, document: Mapping[str, Any], place: Place, told: Callable[[float], None] = lambda _: None
) -> str:
    """Judge the policy of a cell at every value that it was not judged at yet, and keep each verdict.

    Args:
        cell: that was trained.
        document: its result.
        place: of the results, and of the run that holds the policy.
        told: called with each value before it is judged.

    Returns:
        Why that cannot be done; nothing if it was.
    """
    family, inputs = family_of(cell), inputs_of(cell)
    missing = [value for value in family.values if str(value) not in _judged(inputs, document, place.out)]
    run = newest_run(inputs, place) if missing else None
    if missing and run is None:
        return f"its run is gone: remove {place.file(cell)} to train anew"
    for value in missing:
        assert run is not None
        told(value)
        _keep(inputs, document, place.out, {str(value): _verdict(run, family, value, cell.held_out)})
    return ""


def _verdict(run: RunDir, family: Family, value: float, held_out: int) -> dict[str, Any]:
    """How the policy does where the parameter has one value."""
    from stlc.controller.evaluation.held_out import score
    from stlc.controller.training.run import Run

    opened = Run.open(run.path, overrides={family.parameter: f"{value}{family.unit}"})
    return score(opened.task, opened.policy, n=held_out).summary()


# ----------------------------------------------------------------------- what is kept


def _entry(inputs: Inputs, document: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What is kept of a cell; nothing of another training, or of other inputs."""
    entry = (read_json(folder / FILE).get("trainings") or {}).get(inputs.cell.name) or {}
    same = entry.get("key") == inputs.key and entry.get("trained") == document["finished"]
    return entry if same else {}


def _judged(inputs: Inputs, document: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    verdicts: Mapping[str, Any] = _entry(inputs, document, folder).get("values") or {}
    return verdicts


def _keep(
    inputs: Inputs, document: Mapping[str, Any], folder: Path, verdicts: Mapping[str, Mapping[str, Any]]
) -> None:
    family, kept = family_of(inputs.cell), read_json(folder / FILE).get("trainings") or {}
    values = {**_judged(inputs, document, folder), **verdicts}
    kept[inputs.cell.name] = {
        "family": family.name,
        "parameter": family.parameter,
        "unit": family.unit,
        "sampled": list(family.sampled()),
        "key": inputs.key,
        "trained": document["finished"],
        "values": {value: values[value] for value in sorted(values, key=float)},
        **{"date": now(), "versions": versions(), "git": git_state(), "hardware": hardware()},
    }
    write_atomic(folder / FILE, dumps({"format": FORMAT, "trainings": kept}, indent=1) + "\n")


# ----------------------------------------------------------------------- the table


@dataclass(frozen=True, slots=True)
class Row:
    """A family at one value of its parameter for one length of training, over all seeds.

    Attributes:
        family: name.
        value: of the parameter, in the family's unit.
        inside: whether training drew such values.
        length: of training, such as `60 s`.
        seeds: of training.
        accuracy: mean over seeds.
        interval: its 95 % Wilson interval, over the states of all seeds.
        feasible: share of the states for which some satisfying plan is known, mean over seeds.
    """

    family: str
    value: float
    inside: bool
    length: str
    seeds: tuple[int, ...]
    accuracy: float
    interval: tuple[float, float]
    feasible: float

    @property
    def share(self) -> float | None:
        """Of what is known to be feasible."""
        return self.accuracy / self.feasible if self.feasible else None


def family_rows(documents: Iterable[Mapping[str, Any]], folder: Path) -> list[Row]:
    """The table of the results of cells: families, then lengths, then values."""
    from stlc.bench.study import cell_of

    groups: dict[tuple[int, str, float], list[tuple[Cell, Mapping[str, Any]]]] = {}
    for document in documents:
        cell = cell_of(document)
        order = FAMILIES.index(family_of(cell))
        for value, verdict in _judged(inputs_of(cell), document, folder).items():
            groups.setdefault((order, cell.length.text, float(value)), []).append((cell, verdict))
    return [_row(*key, group) for key, group in sorted(groups.items(), key=lambda item: item[0])]


def _row(order: int, length: str, value: float, group: list[tuple[Cell, Mapping[str, Any]]]) -> Row:
    from stlc.controller.evaluation.held_out import wilson

    family = FAMILIES[order]
    low, high = family.sampled()
    accuracy = fmean(float(verdict["accuracy"]) for _, verdict in group)
    return Row(
        family.name,
        value,
        low <= value <= high,
        length,
        tuple(sorted(cell.seed for cell, _ in group)),
        accuracy,
        wilson(accuracy, sum(int(verdict["held_out"]) for _, verdict in group)),
        fmean(float(verdict["feasible"]) for _, verdict in group),
    )


def tables(rows: Sequence[Row]) -> Iterator[tuple[Family, list[Row]]]:
    """The rows of each family."""
    for family in FAMILIES:
        if own := [row for row in rows if row.family == family.name]:
            yield family, own
