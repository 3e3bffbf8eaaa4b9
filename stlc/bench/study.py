"""Filling a table: cells that are there are kept, the others are trained in processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stlc.bench.cells import (
    FORMAT,
    Cell,
    Inputs,
    Study,
    inputs_of,
    length_of,
    pack,
    read_cells,
    read_json,
    spec_path,
)
from stlc.bench.fixed_set import training_accuracy
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.parallel.jobs import Job, JobResult, side_by_side
from stlc.controller.training.inputs import input_files
from stlc.diagnostics import StlcError
from stlc.files import write_atomic
from stlc.jsontext import dumps
from stlc.rundir import RunDir, every_run
from stlc.view.held_out import load_held_out

CURVE_POINTS = 80


@dataclass(frozen=True, slots=True)
class Place:
    """Where results and runs lie, and how many processes make them.

    Attributes:
        out: folder of the results, one JSON file a cell.
        runs: folder of the runs behind them.
        jobs: processes at a time.
        threads: of torch in each.
        cluster: address of a cluster that trains instead of this machine.
    """

    out: Path = Path("bench")
    runs: Path = Path("runs/bench")
    jobs: int = 1
    threads: int = 1
    cluster: str | None = None

    def file(self, cell: Cell) -> Path:
        """The result of a cell."""
        return self.out / f"{cell.name}.json"


@dataclass(frozen=True, slots=True)
class Filled:
    """A cell that was looked at.

    Attributes:
        cell: which.
        document: its result; empty where training broke off.
        kept: it was there already.
        why: what the process said where it broke off.
    """

    cell: Cell
    document: Mapping[str, Any]
    kept: bool = False
    why: str = ""


def fill(
    cells: Sequence[Cell], place: Place, begun: Callable[[str], None] = lambda _: None
) -> Iterator[Filled]:
    """Results of cells: first those that are there, then the others as they are trained.

    Args:
        cells: of the table.
        place: where to look and to write.
        begun: called with the name of a cell as its training starts.
    """
    wanted: dict[str, Inputs] = {}
    for cell in cells:
        inputs, document = inputs_of(cell), read_json(place.file(cell))
        if document.get("format") == FORMAT and inputs.made(document):
            yield Filled(cell, document, kept=True)
        else:
            wanted[cell.name] = inputs
    errands = []
    for inputs in list(wanted.values()):
        run = newest_run(inputs, place)
        if run is not None and run.status == "finished":
            yield Filled(inputs.cell, _collect(inputs, run, place))
        else:
            errands.append(_errand(inputs, place, run))
    for back in _sent(errands, place, begun):
        inputs = wanted[back.errand.name]
        run = newest_run(inputs, place)
        if back.code not in (0, 1) or run is None or run.status != "finished":
            yield Filled(inputs.cell, {}, why=f"exit code {back.code}\n{back.why}".strip())
            continue
        yield Filled(inputs.cell, _collect(inputs, run, place, cores=back.cores))


def runs_of(inputs: Inputs, place: Place) -> Path:
    """The folder of the runs of one cell; other inputs have another one."""
    return place.runs / f"{inputs.cell.name}-{inputs.key}"


def newest_run(inputs: Inputs, place: Place) -> RunDir | None:
    """The newest run of a cell that can be collected or gone on with."""
    runs = every_run(runs_of(inputs, place))
    if not runs or not (runs[-1].path / "ckpt" / "last.json").is_file():
        return None
    try:
        return None if runs[-1].status == "failed" else runs[-1]
    except StlcError:
        return None


def _sent(errands: Sequence[Job], place: Place, begun: Callable[[str], None]) -> Iterator[JobResult]:
    """Errands run where the place says."""
    if place.cluster is None or not errands:
        yield from side_by_side(errands, jobs=place.jobs, begun=lambda errand: begun(errand.name))
        return
    from stlc.controller.parallel.ray_cluster import Cluster, on_cluster

    cluster = Cluster(place.cluster, place.threads)
    yield from on_cluster(errands, cluster, begun=lambda errand: begun(errand.name))


def _errand(inputs: Inputs, place: Place, run: RunDir | None) -> Job:
    """A training, with what another machine needs for it."""
    arguments, runs = _arguments(inputs, place, run), runs_of(inputs, place)
    if place.cluster is None:
        return Job(inputs.cell.name, arguments)
    read = input_files(spec_path(inputs.cell.benchmark), overrides=inputs.cell.overrides)
    return Job(inputs.cell.name, arguments, read if run is None else (run.path,), runs)


def _arguments(inputs: Inputs, place: Place, run: RunDir | None) -> tuple[str, ...]:
    """Of `stlc train`: a new run, or one that was cut short."""
    cell = inputs.cell
    if run is not None:
        return ("--resume", str(run.path), "--no-pictures")
    overrides = [word for key, value in cell.overrides.items() for word in ("--set", f"{key}={value}")]
    return (
        str(spec_path(cell.benchmark)),
        *("--method", cell.method, "--seed", str(cell.seed), *cell.length.options),
        *("--threads", str(place.threads), "--held-out", str(cell.held_out)),
        *("--runs", str(runs_of(inputs, place)), "--no-pictures", *overrides),
    )


def _collect(inputs: Inputs, run: RunDir, place: Place, *, cores: int | None = None) -> dict[str, Any]:
    """Everything that is known about a run, as one document, which is written."""
    record, cell = run.record(), inputs.cell
    held = load_held_out(run.path / "eval" / "held_out.npz")
    solved = [] if held is None else [rho >= -TOLERANCE for rho in held.rho.tolist()]
    document = {
        "format": FORMAT,
        "study": cell.study,
        "benchmark": cell.benchmark,
        "method": cell.method,
        "axis": cell.axis,
        "value": cell.value,
        **inputs.values,
        **record["result"],
        "spec_path": record["spec_path"],
        "system_path": record["system_path"],
        "training_accuracy": training_accuracy(run),
        "steps": record["steps"],
        "margin": record["margin"],
        "solved": pack(solved),
        "ceiling": None,
        "curve": _curve(run),
        "command": ["stlc", *record["command"]],
        "threads": record["threads"],
        "cores": cores,
        **{key: record[key] for key in ("stlc", "versions", "git", "hardware", "started", "finished")},
    }
    write_result(place, document)
    return document


def cell_of(document: Mapping[str, Any]) -> Cell:
    """Which cell a result is of."""
    return Cell(
        document["benchmark"],
        document["method"],
        document["seed"],
        length_of(document),
        document["held_out"],
        document["axis"],
        document["value"],
        document["overrides"],
    )


def write_result(place: Place, document: Mapping[str, Any]) -> None:
    """Write the result of a cell into its file."""
    write_atomic(place.file(cell_of(document)), dumps(document, indent=1) + "\n")


def valid_results(folder: Path, study: Study | None = None) -> list[dict[str, Any]]:
    """The results (of one study) in a folder whose specification, system and engine are those of today."""
    found = [document for document in read_cells(folder) if study in (None, document["study"])]
    return [document for document in found if inputs_of(cell_of(document)).made(document)]


def _curve(run: RunDir) -> list[dict[str, float | None]]:
    """Accuracy on fresh states over time, at most `CURVE_POINTS` points."""
    rows = [row for row in run.rows() if row.get("accuracy") is not None]
    every = max(1, -(-len(rows) // CURVE_POINTS))
    kept = rows[::-1][::every][::-1]
    return [{key: row.get(key) for key in ("seconds", "step", "accuracy", "feasible")} for row in kept]
