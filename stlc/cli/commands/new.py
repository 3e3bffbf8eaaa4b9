"""`stlc new`: one file from a template."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.framework.options import JsonOption, describe, only_help
from stlc.cli.framework.output import emit, emit_json, say
from stlc.escape import operand, shell, visible

_Name = Annotated[str, typer.Argument(metavar="NAME", help="Of what is made; a path says where.")]
_Force = Annotated[bool, typer.Option("--force", help="Overwrite a file that is there.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    group = typer.Typer(
        name="new",
        help=describe("Make a specification or a system.", "stlc new spec parking"),
        invoke_without_command=True,
        rich_markup_mode=None,
    )
    group.callback()(only_help)
    group.command(
        help=describe(
            "Write a specification to begin with.",
            "stlc new spec parking",
            "stlc new spec parking --from car.yaml",
            note="With --from it has a signal line for each state of the system.",
        )
    )(spec)
    group.command(help=describe("Write a system file to begin with.", "stlc new system cart"))(system)
    app.add_typer(group)


def spec(
    name: _Name,
    from_: Annotated[
        str | None, typer.Option("--from", metavar="SYSTEM", help="A system whose states are the signals.")
    ] = None,
    force: _Force = False,
    as_json: JsonOption = False,
) -> None:
    """Write `NAME.stl`, into `specs/` where there is such a folder."""
    from stlc.cli.framework.templates import checked_name, spec_text, write_new
    from stlc.grammar.format.format import format_text
    from stlc.source import Source

    path = _path(name, "specs", ".stl")
    checked_name(path.stem)
    decl = None
    reference = ""
    if from_ is not None:
        from stlc.dynamics.declaration.load import load_system_decl
        from stlc.files import find_system

        decl = load_system_decl(find_system(from_))
        reference = Path(os.path.relpath(decl.path, path.parent)).as_posix()
    text = spec_text(path.stem, decl, reference)
    write_new(path, format_text(Source(str(path), text)), force=force)
    _done(path, shell(("stlc", "lint", operand(str(path)))), as_json=as_json)


def system(name: _Name, force: _Force = False, as_json: JsonOption = False) -> None:
    """Write `NAME.yaml`, into `systems/` where there is such a folder."""
    from stlc.cli.framework.templates import checked_name, read_template, write_new

    path = _path(name, "systems", ".yaml")
    checked_name(path.stem)
    write_new(path, read_template("system.yaml").format(name=path.stem), force=force)
    _done(path, shell(("stlc", "system", "show", operand(str(path)))), as_json=as_json)


def _path(name: str, folder: str, suffix: str) -> Path:
    """Where the file goes: as given, or into the folder of its kind."""
    given = Path(name)
    path = given if given.suffix in (suffix, ".stlc", ".yml") else given.with_name(f"{given.name}{suffix}")
    return Path(folder) / path if path.parent == Path() and Path(folder).is_dir() else path


def _done(path: Path, following: str, *, as_json: bool) -> None:
    if as_json:
        emit_json("new/1", ok=True, exit_code=0, result={"path": str(path)})
        return
    emit(visible(str(path)))
    say(f"next: {following}")
