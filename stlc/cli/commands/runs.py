"""`stlc runs`: the runs in a folder, one of them, two compared, one removed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import JsonOption, RunArgument
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.cli.framework.program import group, subcommand
from stlc.diagnostics import Diagnostic, StlcError, UsageError
from stlc.escape import visible
from stlc.rundir import RunDir, every_run

Sort = Literal["time", "acc", "name"]

_Runs = Annotated[Path, typer.Option("--runs", help="Folder of all runs.")]
RUNS = Path("runs")


def _default(context: typer.Context) -> None:
    """Without a command: list."""
    if context.invoked_subcommand is None:
        list_()


GROUP = group("List, show, compare and remove runs.", "stlc runs", default=_default)


@subcommand(GROUP, "list", "stlc runs list --sort acc")
def list_(
    sort: Annotated[Sort, typer.Option(help="Newest last, best last, or by name.")] = "time",
    runs: _Runs = RUNS,
    as_json: JsonOption = False,
) -> None:
    """List all runs."""
    rows = overview(runs, sort)
    if as_json:
        emit_json("runs/1", ok=True, exit_code=0, result={"runs": [row.values() for row in rows]})
    elif rows:
        header = ("run", "system", "status", "accuracy", "steps", "time", "started")
        emit(table([row.cells() for row in rows], header=header))
    else:
        say(f"there is no run in {runs}; train one: stlc train specs/traffic.stl --system car.yaml")


@subcommand(GROUP, "show", "stlc runs show latest")
def show(run: RunArgument = "latest", runs: _Runs = RUNS, as_json: JsonOption = False) -> None:
    """Show the settings and results of a run."""
    folder = RunDir.open(run, runs)
    record = folder.record()
    files = sorted(str(path.relative_to(folder.path)) for path in folder.path.rglob("*") if path.is_file())
    if as_json:
        result = {"run": folder.shown, "record": record, "files": files}
        emit_json("runs/1", ok=True, exit_code=0, result=result)
        return
    emit(visible(folder.shown))
    facts = flattened(record)
    width = max(map(len, facts), default=0)
    emit("\n".join(visible(f"  {key:<{width}}  {value}") for key, value in facts.items()))
    emit("files\n" + "\n".join(visible(f"  {name}") for name in files))


@subcommand(GROUP, "diff", "stlc runs diff 1 2")
def diff(
    first: RunArgument,
    second: Annotated[str, typer.Argument(metavar="OTHER", help="The run to compare with.")] = "latest",
    runs: _Runs = RUNS,
    as_json: JsonOption = False,
) -> None:
    """Show the differences of two runs: options, inputs, results.

    Exit code: 0, or 1 if they differ.
    """
    one, other = RunDir.open(first, runs), RunDir.open(second, runs)
    facts = differences(flattened(one.record()), flattened(other.record()))
    texts = [
        name for name in ("spec.stl", "system.yaml") if _text(one.path / name) != _text(other.path / name)
    ]
    code = 1 if facts or texts else 0
    if as_json:
        rows = [{"key": key, "values": values} for key, *values in facts]
        result = {"runs": [one.shown, other.shown], "facts": rows, "files": texts}
        emit_json("runs/1", ok=code == 0, exit_code=code, result=result)
    else:
        rows_ = [*facts, *((name, "differs", "differs") for name in texts)]
        header = ("", one.name, other.name)
        emit(table(rows_, header=header) if rows_ else f"{one.name} and {other.name} do not differ")
    raise typer.Exit(code)


@subcommand(GROUP, "rm", "stlc runs rm 3")
def rm(
    names: Annotated[
        list[str], typer.Argument(metavar="RUN…", help="Runs to remove.", autocompletion=run_names)
    ],
    force: Annotated[bool, typer.Option("--force", help="Also those that are still going.")] = False,
    runs: _Runs = RUNS,
    as_json: JsonOption = False,
) -> None:
    """Remove the folders of runs.

    A running one needs --force. The links to the newest run are updated.
    """
    from stlc.rundir import remove_run

    folders = [RunDir.open(name, runs) for name in names]
    going = [folder.shown for folder in folders if folder.status == "running"]
    if going and not force:
        advice = ("stop it first, or remove it with --force",)
        raise UsageError(Diagnostic("U101", f"{', '.join(going)} is still going", help=advice))
    for folder in folders:
        remove_run(folder)
    removed = [folder.shown for folder in folders]
    if as_json:
        emit_json("runs/1", ok=True, exit_code=0, result={"removed": removed})
    else:
        for name in removed:
            say(f"removed {name}")


def flattened(record: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """A nested record as `key.sub` -> text."""
    flat: dict[str, str] = {}
    for key, value in record.items():
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = f"{value:.6g}" if isinstance(value, float) else str(value)
    return flat


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


# -------------------------------------------------------------------------- table

_VOLATILE = ("started", "finished", "command", "result.seconds", "seconds")


@dataclass(frozen=True, slots=True)
class RunRow:
    """One run.

    Attributes:
        run: `spec/number-words`.
        path: of its folder.
        record: of `run.json`; empty where it is damaged.
        status: of the run, or "damaged".
    """

    run: str
    path: str
    record: Mapping[str, Any]
    status: str

    @property
    def accuracy(self) -> float | None:
        """Share of held-out starts whose plan satisfies the specification."""
        result = self.record.get("result")
        value = result.get("accuracy") if isinstance(result, Mapping) else None
        return float(value) if isinstance(value, int | float) else None

    def cells(self) -> tuple[str, ...]:
        """Table cells as text."""
        record, accuracy = self.record, self.accuracy
        result = record.get("result")
        seconds = result.get("seconds") if isinstance(result, Mapping) else None
        return (
            self.run,
            Path(str(record.get("system_path", ""))).name,
            self.status,
            "" if accuracy is None else f"{accuracy:.4f}",
            str(record.get("steps") or ""),
            f"{seconds:.0f} s" if isinstance(seconds, int | float) else "",
            str(record.get("started", "")),
        )

    def values(self) -> dict[str, Any]:
        """The row as JSON values."""
        kept = {key: self.record.get(key) for key in ("spec", "system_path", "steps", "seed", "started")}
        return {"run": self.run, "path": self.path, "status": self.status, "accuracy": self.accuracy, **kept}


def overview(root: Path, sort: str) -> list[RunRow]:
    """All runs below a folder; a damaged one is listed instead of raising an error."""
    rows = [_row(run) for run in every_run(root)]
    if sort == "acc":
        return sorted(rows, key=lambda row: -1.0 if row.accuracy is None else row.accuracy)
    return sorted(rows, key=lambda row: str(row.record.get("started", ""))) if sort == "time" else rows


def _row(run: RunDir) -> RunRow:
    name = f"{run.path.parent.name}/{run.name}"
    try:
        record = run.record()
    except StlcError:
        return RunRow(name, run.shown, {}, "damaged")
    return RunRow(name, run.shown, record, str(record.get("status", "running")))


def differences(one: Mapping[str, str], other: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """(key, value, other value) where two flat records differ; timestamps are left out."""
    keys = [key for key in {**one, **other} if key not in _VOLATILE]
    return [(key, one.get(key, ""), other.get(key, "")) for key in keys if one.get(key) != other.get(key)]
