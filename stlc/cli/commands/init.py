"""`stlc init`: create a project, or one specification or system."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.framework.output import Answer, emit, say
from stlc.cli.framework.program import command
from stlc.diagnostics import usage
from stlc.escape import operand, shell, visible
from stlc.files import File

if TYPE_CHECKING:
    from stlc.dynamics.declaration.decl import SystemDecl
    from stlc.signature import Column

FIRST, EMPTY = "cart", "empty"
FOLDER = Path(__file__).parents[2] / "templates"

_SETTINGS = {
    ".gitattributes": "*.stl linguist-language=Text diff\n",
    ".gitignore": "runs/\n__pycache__/\n",
    ".vscode/settings.json": '{\n  "files.associations": {"*.stl": "stlc"}\n}\n',
}
_NAME = re.compile(r"[^\W\d]\w*")
_SYSTEM = re.compile(r'^(system\s+")[^"\n]*?([^"/\n]+\.yaml)"', re.MULTILINE)
_JUDGE = re.compile(r"^ *judge: *(?:[^\s#]*/)?([\w-]+\.stl)\b", re.MULTILINE)
_BESIDE = re.compile(r"[\w-]+\.(?:py|urdf)\b")


def examples(incomplete: str = "") -> list[str]:
    """Return the names of examples that begin with the text `incomplete`, for shell completion.

    The examples are `cart`, `empty`, and every installed system that an installed specification names.
    """
    found = {system.removesuffix(".yaml") for _, system in _pairs()}
    return [name for name in (FIRST, *sorted(found), EMPTY) if name.startswith(incomplete)]


@dataclass(frozen=True, slots=True)
class CreatedFiles:
    """Files that were written."""

    files: Sequence[str]


@command(
    "stlc init my-project",
    "stlc init my-project --example car",
    "stlc init --spec parking --from car.yaml",
    "stlc init --system cart",
)
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the project.")] = Path(),
    example: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Such as cart, car, or empty.", show_default="cart", autocompletion=examples
        ),
    ] = None,
    spec: Annotated[
        str | None, typer.Option("--spec", metavar="NAME", help="Write this specification only.")
    ] = None,
    from_: Annotated[
        str | None,
        typer.Option(
            "--from", metavar="SYSTEM", help="With --spec: a system whose states become the signals."
        ),
    ] = None,
    system: Annotated[
        str | None, typer.Option("--system", metavar="NAME", help="Write this system file only.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that are there.")] = False,
) -> Answer[CreatedFiles]:
    """Create a project, or one specification or system.

    The project contains an example that trains in a minute, and settings for git and the editor. Existing
    files are overwritten only with --force. --spec and --system write only one file, into `specs/` and
    `systems/` if these folders exist.
    """
    if sum(given is not None for given in (example, spec, system)) > 1:
        raise usage("`--example`, `--spec` and `--system` contradict each other")
    if from_ is not None and spec is None:
        raise usage("`--from` needs `--spec NAME`")
    if spec is not None:
        files, following = _specification(folder, spec, from_)
    elif system is not None:
        path = _path(folder, system, "systems", ".yaml")
        files = {path: _template("system.yaml").format(name=path.stem)}
        following = shell(("stlc", "system", "show", operand(str(path))))
    else:
        files = {folder / name: text for name, text in _project(example or FIRST).items()}
        here = "" if folder == Path() else f"{shell(('cd', operand(str(folder))))} && "
        following = here + _following(files)
    there = [str(path) for path in files if path.exists()]
    if there and not force:
        verb = "is" if len(there) == 1 else "are"
        raise usage(f"{', '.join(there)} {verb} there already", "overwrite: --force")
    for path, text in files.items():
        File(path).write(text)
    if spec is None and system is None:
        for name in ("specs", "systems"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def show() -> None:
        for path in files:
            emit(visible(str(path)))
        say(f"next: {following}")

    return Answer(CreatedFiles([*map(str, files)]), show)


# ------------------------------------------------------------------------ a project


def _project(example: str) -> dict[str, str]:
    """Return the files of a new project: path within the project -> text.

    Raises:
        UsageError: U101, there is no such example.
    """
    if example == EMPTY:
        return dict(_SETTINGS)
    if example == FIRST:
        cart = {"specs/cart.stl": _template("cart.stl"), "systems/cart.yaml": _template("cart.yaml")}
        return _SETTINGS | cart
    return _SETTINGS | _example_files(example)


def _following(files: Mapping[Path, str]) -> str:
    """Return the command to run next: the training for the first specification in `files` (path -> text).

    A specification by which a system file judges closed-loop runs is skipped, because no policy is trained
    for it.
    """
    systems = (text for path, text in files.items() if path.suffix == ".yaml")
    judging = {name for text in systems for name in _JUDGE.findall(text)}
    for path in files:
        if path.suffix == ".stl" and path.name not in judging:
            return shell(("stlc", "train", f"specs/{path.name}", "--budget", "60s"))
    return "stlc init --system cart"


def _example_files(name: str) -> dict[str, str]:
    """Return the files of the example `name`, as a mapping from the path in the project to the text.

    They are an installed system file, the files to which it refers, and its specifications.
    """
    specs = [path for path, system in _pairs() if name in (system.removesuffix(".yaml"), path.stem)]
    if not specs:
        note = (f"there are {', '.join(examples())}",)
        raise usage(f"there is no example `{name}`", note=note).near(name, examples())
    files: dict[str, str] = {}
    judges = [
        File.SPECS / judge for _, system in _pairs(specs) for judge in _JUDGE.findall(_installed(system))
    ]
    for path in dict.fromkeys((*specs, *judges)):
        text = path.read_text(encoding="utf-8")
        system = next(found[2] for found in _SYSTEM.finditer(text))
        files[f"specs/{path.name}"] = _SYSTEM.sub(r'\1../systems/\2"', text)
        beside = [
            word
            for word in dict.fromkeys(_BESIDE.findall(_installed(system)))
            if (File.SYSTEMS / word).is_file()
        ]
        files |= {f"systems/{file}": _installed(file) for file in (system, *beside)}
    return files


def _pairs(specs: Iterable[Path] | None = None) -> Iterator[tuple[Path, str]]:
    """Yield (path of a specification, name of the installed system file to which it refers).

    The specifications are `specs`, or by default all installed ones. A specification that refers to no
    installed system file is skipped.
    """
    for path in sorted(File.SPECS.glob("*.stl")) if specs is None else specs:
        named = _SYSTEM.search(path.read_text(encoding="utf-8"))
        if named and (File.SYSTEMS / named[2]).is_file():
            yield path, named[2]


def _installed(name: str) -> str:
    return (File.SYSTEMS / name).read_text(encoding="utf-8")


def _template(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


# ------------------------------------------------------------------------- one file


def _specification(folder: Path, name: str, from_: str | None) -> tuple[dict[Path, str], str]:
    """Path and text of the new specification `name`, which declares a signal for each state of a system.

    The system is the one called `from_`. If `from_` is None, the specification declares an example signal.

    Returns:
        Path -> text, and the command to run next.
    """
    from stlc.grammar.format.format import format_text
    from stlc.source import Source

    path, decl, reference = _path(folder, name, "specs", ".stl"), None, ""
    if from_ is not None:
        from stlc.dynamics.load import load_system_decl
        from stlc.files import File

        decl = load_system_decl(File(from_).system())
        reference = Path(os.path.relpath(decl.path, path.parent)).as_posix()
    text = format_text(Source(str(path), _spec_text(path.stem, decl, reference)))
    return {path: text}, shell(("stlc", "lint", operand(str(path))))


def _path(folder: Path, name: str, kind: str, suffix: str) -> Path:
    """Path of a new file in `folder`; `suffix` is added to `name` if it has none.

    If `name` contains no folder, and `folder` has a subfolder `kind` (such as `specs`), the file is placed
    there.

    Raises:
        UsageError: U101, `name` is not a valid name of the language.
    """
    from stlc.grammar.words import BUILT_IN, RESERVED

    given = Path(name)
    path = given if given.suffix in (suffix, ".stlc", ".yml") else given.parent / f"{given.name}{suffix}"
    if not _NAME.fullmatch(path.stem) or path.stem in RESERVED or path.stem in BUILT_IN:
        advice = ("letters, digits and `_`, none of the words of the language",)
        raise usage(f"`{path.stem}` cannot be a name", *advice)
    return folder / kind / path if path.parent == Path() and (folder / kind).is_dir() else folder / path


def _spec_text(name: str, system: SystemDecl | None, reference: str) -> str:
    """Text of a new specification.

    Args:
        name: name of the specification.
        system: system whose states are declared as signals; None for an example signal.
        reference: path by which the specification refers to that system.
    """
    if system is None:
        signals, predicate = "signal x [m] in [-5, 5]", "x < 4 m"
    else:
        columns = system.signature.columns
        signals = "\n".join(map(_signal, columns))
        predicate = _predicate(columns[0])
    return _template("spec.stl").format(
        name=name,
        system=f'system "{reference}"\n' if reference else "",
        signals=signals,
        requirement="stays",
        predicate=predicate,
    )


def _signal(column: Column) -> str:
    from stlc.grammar.printer import own_name

    role = column.role if column.role in ("input", "output", "state", "env") else "state"
    head = f"{role} signal {own_name(column.name)}"
    if column.kind == "bool":
        return f"{head} : bool"
    if column.labels:
        members = ", ".join(f"{own_name(label)} = {value:g}" for label, value in column.labels)
        kind = column.name.capitalize()
        return f"enum {kind} {{ {members} }}\n{head} : {kind}"
    unit = f" [{column.unit}]" if column.unit.text else ""
    limits = "" if column.low is None or column.high is None else f" in [{column.low:g}, {column.high:g}]"
    return f"{head}{unit}{limits}"


def _predicate(column: Column) -> str:
    from stlc.grammar.printer import own_name

    if column.kind == "bool":
        return own_name(column.name)
    if column.labels:
        return f"{own_name(column.name)} == {own_name(column.labels[0][0])}"
    high = 0.0 if column.high is None else column.high
    return f"{own_name(column.name)} <= {high:g}" + (f" {column.unit}" if column.unit.text else "")
