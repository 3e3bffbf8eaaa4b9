"""`stlc init`: a project of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from stlc.cli.options import JsonOption, describe
from stlc.cli.output import emit, emit_json, say

Example = Literal["cart", "empty"]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        help=describe(
            "Begin a project: folders, settings, and an example that trains in a minute.",
            "stlc init my-project",
            "stlc init my-project --example empty",
            note="Nothing that is there is overwritten unless --force is given.",
        )
    )(init)


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the project.")] = Path(),
    example: Annotated[Example, typer.Option(help="What it begins with.")] = "cart",
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that are there.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write the files of a project into `folder`."""
    from stlc.cli.templates import require_new
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
        emit(str(path))
    here = "" if folder == Path() else f"cd {folder} && "
    say(f"next: {here}{_NEXT[example]}")


_NEXT = {"cart": "stlc train specs/cart.stl --budget 20s", "empty": "stlc new system cart"}


def _files(example: Example) -> dict[str, str]:
    """Path within the project -> text."""
    from stlc.cli.templates import ATTRIBUTES, EDITOR, IGNORED, read_template

    files = {".gitattributes": ATTRIBUTES, ".gitignore": IGNORED, ".vscode/settings.json": EDITOR}
    if example == "cart":
        files |= {
            "specs/cart.stl": read_template("cart.stl"),
            "systems/cart.yaml": read_template("cart.yaml"),
        }
    return files
