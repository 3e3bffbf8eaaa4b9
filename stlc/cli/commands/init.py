"""`stlc init`: a project of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from stlc.cli.framework.examples import EMPTY, FIRST, example_files, examples, judges
from stlc.cli.framework.options import JsonOption, describe
from stlc.cli.framework.output import emit, emit_json, say
from stlc.escape import operand, shell, visible


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        help=describe(
            "Begin a project with an example that trains in a minute.",
            "stlc init my-project",
            "stlc init my-project --example car",
            note="Settings of git and of the editor come with it. Nothing that is there is overwritten "
            "unless --force is given.",
        )
    )(init)


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the project.")] = Path(),
    example: Annotated[
        str,
        typer.Option(metavar="NAME", help="cart, car, …, or empty.", autocompletion=examples),
    ] = "cart",
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that are there.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write the files of a project into `folder`."""
    from stlc.cli.framework.templates import require_new
    from stlc.files import write_atomic

    files = {folder / name: text for name, text in _files(example).items()}
    require_new(list(files), force=force)
    for path, text in files.items():
        write_atomic(path, text)
    for name in ("specs", "systems"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    if as_json:
        emit_json("init/1", ok=True, exit_code=0, result={"files": [str(path) for path in files]})
        return
    for path in files:
        emit(visible(str(path)))
    here = "" if folder == Path() else f"{shell(('cd', operand(str(folder))))} && "
    say(f"next: {here}{_following(files)}")


def _following(files: Mapping[Path, str]) -> str:
    """The command to go on with: training for the first specification that plans are made for."""
    judging = judges(text for path, text in files.items() if path.suffix == ".yaml")
    for path in files:
        if path.suffix == ".stl" and path.name not in judging:
            return shell(("stlc", "train", f"specs/{path.name}", "--budget", "60s"))
    return "stlc new system cart"


def _files(example: str) -> dict[str, str]:
    """Path within the project -> text."""
    from stlc.cli.framework.templates import ATTRIBUTES, EDITOR, IGNORED, read_template

    files = {".gitattributes": ATTRIBUTES, ".gitignore": IGNORED, ".vscode/settings.json": EDITOR}
    if example == EMPTY:
        return files
    if example == FIRST:
        specs = {"specs/cart.stl": read_template("cart.stl"), "systems/cart.yaml": read_template("cart.yaml")}
        return files | specs
    return files | example_files(example)
