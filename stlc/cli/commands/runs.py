"""`stlc runs`: list the runs in a folder, show one, compare two, remove some."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import RunArgument
from stlc.cli.framework.output import Answer, emit, say, table
from stlc.cli.framework.program import group, subcommand
from stlc.diagnostics import StlcError, usage
from stlc.escape import visible
from stlc.options import Options
from stlc.rundir import RunDir


@dataclass(frozen=True, slots=True)
class ListedRun:
    """A run with the facts of its `run.json`, as they stand there."""

    run: str
    path: str
    status: str
    accuracy: float | None
    spec: Any
    system_path: Any
    steps: Any
    seed: Any
    started: Any


@dataclass(frozen=True, slots=True)
class RunList:
    """Runs of a folder."""

    runs: Sequence[ListedRun]


@dataclass(frozen=True, slots=True)
class DifferentFact:
    """Fact in which two runs differ, with both values."""

    key: str
    values: Sequence[str]


@dataclass(frozen=True, slots=True)
class RunComparison:
    """Differences of two runs: facts, and names of input files."""

    runs: Sequence[str]
    facts: Sequence[DifferentFact]
    files: Sequence[str]


@dataclass(frozen=True, slots=True)
class RunContent:
    """A run, its `run.json`, and the files in its folder."""

    run: str
    record: Mapping[str, Any]
    files: Sequence[str]


@dataclass(frozen=True, slots=True)
class RemovedRuns:
    """Runs that were removed."""

    removed: Sequence[str]


Sort = Literal["time", "acc", "name"]


def _default(context: typer.Context) -> None:
    """List the runs if no subcommand is given."""
    if context.invoked_subcommand is None:
        list_().show()


GROUP = group("List, show, compare and remove runs.", "stlc runs", default=_default)


@subcommand(GROUP, "list", "stlc runs list --sort acc")
def list_(
    sort: Annotated[Sort, typer.Option(help="Newest last, best last, or by name.")] = "time",
    runs: Options.Runs = RunDir.RUNS,
) -> Answer[RunList]:
    """List all runs."""
    found = [(run, *_record(run)) for run in RunDir.every(runs)]
    if sort == "acc":
        found.sort(key=lambda each: -1.0 if (share := _accuracy(each[1])) is None else share)
    if sort == "time":
        found.sort(key=lambda each: str(each[1].get("started", "")))

    def show() -> None:
        header = ("run", "system", "status", "accuracy", "steps", "time", "started")
        if found:
            emit(table([_cells(*each) for each in found], header=header))
        else:
            say(f"there is no run in {runs}; train one: stlc train specs/traffic.stl --system car.yaml")

    listed = []
    for run, record, status in found:
        facts = {name: record.get(name) for name in ("spec", "system_path", "steps", "seed", "started")}
        name = f"{run.path.parent.name}/{run.name}"
        listed.append(ListedRun(name, run.shown, status, _accuracy(record), **facts))
    return Answer(RunList(listed), show)


@subcommand(GROUP, "show", "stlc runs show latest")
def show(run: RunArgument = "latest", runs: Options.Runs = RunDir.RUNS) -> Answer[RunContent]:
    """Show the settings and results of a run."""
    folder = RunDir.open(run, runs)
    record = folder.record()
    files = sorted(str(path.relative_to(folder.path)) for path in folder.path.rglob("*") if not path.is_dir())

    def tell() -> None:
        emit(visible(folder.shown))
        facts = flattened(record)
        width = max(map(len, facts), default=0)
        emit("\n".join(visible(f"  {key:<{width}}  {value}") for key, value in facts.items()))
        emit("files\n" + "\n".join(visible(f"  {name}") for name in files))

    return Answer(RunContent(folder.shown, record, files), tell)


@subcommand(GROUP, "diff", "stlc runs diff 1 2")
def diff(
    first: RunArgument,
    second: Annotated[str, typer.Argument(metavar="OTHER", help="The run to compare with.")] = "latest",
    runs: Options.Runs = RunDir.RUNS,
) -> Answer[RunComparison]:
    """Show the differences between two runs: options, inputs, results.

    Exit code: 0, or 1 if they differ.
    """
    one, other = RunDir.open(first, runs), RunDir.open(second, runs)
    facts = differences(flattened(one.record()), flattened(other.record()))
    texts = [name for name in (RunDir.SPEC, RunDir.SYSTEM) if _text(one, name) != _text(other, name)]
    rows = [*facts, *((name, "differs", "differs") for name in texts)]
    text = table(rows, header=("", one.name, other.name))
    values = [DifferentFact(key, pair) for key, *pair in facts]
    return Answer(
        RunComparison((one.shown, other.shown), values, texts),
        lambda: emit(text if rows else f"{one.name} and {other.name} do not differ"),
        1 if rows else 0,
    )


@subcommand(GROUP, "rm", "stlc runs rm 3")
def rm(
    names: Annotated[
        list[str], typer.Argument(metavar="RUN…", help="Runs to remove.", autocompletion=run_names)
    ],
    force: Annotated[bool, typer.Option("--force", help="Also runs in progress, and damaged ones.")] = False,
    runs: Options.Runs = RunDir.RUNS,
) -> Answer[RemovedRuns]:
    """Remove the folders of runs.

    A run that is in progress or damaged is removed only with --force. The links to the newest run are
    updated.
    """
    named = [RunDir.found(name, runs) for name in names]
    folders = list({folder.path.resolve(): folder for folder in named}.values())
    going = [] if force else [folder.shown for folder in folders if folder.status == "running"]
    if going:
        advice = ("stop it first, or remove it with --force",)
        raise usage(f"{', '.join(going)} is still going", *advice)
    for folder in folders:
        folder.remove()
    removed = [folder.shown for folder in folders]

    def tell() -> None:
        for name in removed:
            say(f"removed {name}")

    return Answer(RemovedRuns(removed), tell)


def flattened(record: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Flatten a nested record into a mapping from dotted names (`key.sub`) to texts."""
    flat: dict[str, str] = {}
    for key, value in record.items():
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = f"{value:.6g}" if isinstance(value, float) else str(value)
    return flat


def _text(run: RunDir, name: str) -> bytes | None:
    return run.read(name) if run.has(name) else None


def _record(run: RunDir) -> tuple[Mapping[str, Any], str]:
    """Content of `run.json` and the status of a run; an empty mapping and "damaged" if it cannot be read."""
    try:
        record = run.record()
    except StlcError:
        return {}, "damaged"
    return record, str(record.get("status", "running"))


def _accuracy(record: Mapping[str, Any]) -> float | None:
    """Return the accuracy stored in the record of a run, or None if the record has none.

    The accuracy is the share of validation states (never used in training) for which the plan of the policy
    satisfies the specification.
    """
    return _result(record, "accuracy")


def _result(record: Mapping[str, Any], name: str) -> float | None:
    """Entry `name` of the result in the record of a run; None if it is not there, or is no finite number."""
    result = record.get("result")
    value = result.get(name) if isinstance(result, Mapping) else None
    with suppress(OverflowError):
        return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
    return None


def _cells(run: RunDir, record: Mapping[str, Any], status: str) -> tuple[str, ...]:
    """Texts of a run's row in the table of `stlc runs list`.

    `record` is the content of `run.json`, and `status` the status of the run.
    """
    accuracy, seconds = _accuracy(record), _result(record, "seconds")
    return (
        f"{run.path.parent.name}/{run.name}",
        Path(str(record.get("system_path", ""))).name,
        status,
        "" if accuracy is None else f"{accuracy:.4f}",
        _steps(run, record, status),
        "" if seconds is None else f"{seconds:.0f} s",
        str(record.get("started", "")),
    )


def _steps(run: RunDir, record: Mapping[str, Any], status: str) -> str:
    """Number of steps of a finished run; of another one the steps made until now, and those planned."""
    planned = str(record.get("steps") or "")
    if status == "finished" or not planned:
        return planned
    with suppress(StlcError):
        done = [row["step"] for row in run.rows() if isinstance(row.get("step"), int)]
        return f"{done[-1] if done else 0} of {planned}"
    return planned


_VOLATILE = ("started", "finished", "command", "result.seconds", "seconds")


def differences(one: Mapping[str, str], other: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Differences of two flattened records as (key, value, other value); timestamps are not compared."""
    keys = [key for key in {**one, **other} if key not in _VOLATILE]
    return [(key, one.get(key, ""), other.get(key, "")) for key in keys if one.get(key) != other.get(key)]
