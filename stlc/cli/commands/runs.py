"""`stlc runs`: the runs in a folder, one of them, two compared, one removed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import JsonOption, RunArgument, describe
from stlc.cli.framework.output import emit, emit_json, say, table
from stlc.diagnostics import Diagnostic, UsageError
from stlc.escape import visible

Sort = Literal["time", "acc", "name"]

_Runs = Annotated[Path, typer.Option("--runs", help="Folder of all runs.")]
RUNS = Path("runs")


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    group = typer.Typer(
        name="runs",
        help=describe("List, show, compare and remove runs.", "stlc runs"),
        invoke_without_command=True,
        rich_markup_mode=None,
    )
    group.callback()(_default)
    group.command("list", help=describe("List all runs.", "stlc runs list --sort acc"))(list_)
    group.command(help=describe("Show what a run was, and what came of it.", "stlc runs show latest"))(show)
    group.command(
        help=describe("Say in what two runs differ: options, inputs, results.", "stlc runs diff 1 2")
    )(diff)
    group.command(
        help=describe(
            "Remove the folders of runs.",
            "stlc runs rm 3",
            note="A run that is still going needs --force. The links to the newest run follow.",
        )
    )(rm)
    app.add_typer(group)


def _default(context: typer.Context) -> None:
    """Without a command: list."""
    if context.invoked_subcommand is None:
        list_()


def list_(
    sort: Annotated[Sort, typer.Option(help="Newest last, best last, or by name.")] = "time",
    runs: _Runs = RUNS,
    as_json: JsonOption = False,
) -> None:
    """Print a table of all runs."""
    from stlc.cli.commands.run_table import overview

    rows = overview(runs, sort)
    if as_json:
        emit_json("runs/1", ok=True, exit_code=0, result={"runs": [row.values() for row in rows]})
    elif rows:
        header = ("run", "system", "status", "accuracy", "steps", "time", "started")
        emit(table([row.cells() for row in rows], header=header))
    else:
        say(f"there is no run in {runs}; train one: stlc train specs/traffic.stl --system car.yaml")


def show(run: RunArgument = "latest", runs: _Runs = RUNS, as_json: JsonOption = False) -> None:
    """Print the record of `run`."""
    from stlc.rundir import RunDir

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


def diff(
    first: RunArgument,
    second: Annotated[str, typer.Argument(metavar="OTHER", help="The run to compare with.")] = "latest",
    runs: _Runs = RUNS,
    as_json: JsonOption = False,
) -> None:
    """Print in what two runs differ. Exit with 1 if they do."""
    from stlc.cli.commands.run_table import differences
    from stlc.rundir import RunDir

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


def rm(
    names: Annotated[
        list[str], typer.Argument(metavar="RUN…", help="Runs to remove.", autocompletion=run_names)
    ],
    force: Annotated[bool, typer.Option("--force", help="Also those that are still going.")] = False,
    runs: _Runs = RUNS,
    as_json: JsonOption = False,
) -> None:
    """Remove the folders of runs."""
    from stlc.rundir import RunDir, remove_run

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
    """A record as `key.sub` -> text."""
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
