"""`stlc parse`: the syntax tree of a specification."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stlc.cli.framework.options import JsonOption, describe
from stlc.cli.framework.output import emit, emit_json
from stlc.diagnostics import Diagnostic, SpecError

if TYPE_CHECKING:
    from stlc.grammar import ast

Layout = Literal["tree", "json", "dot"]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command(
        help=describe(
            "Print the syntax tree of specifications.",
            "stlc parse specs/traffic.stl",
            "stlc parse specs/traffic.stl --ast dot | dot -Tsvg > traffic.svg",
            note="Syntax only: names, types and units are looked at by `stlc lint`.",
        ),
    )(parse)


def parse(
    files: Annotated[list[str], typer.Argument(metavar="FILE…", help="Specifications, folders, or -.")],
    layout: Annotated[Layout, typer.Option("--ast", help="How the tree is written.")] = "tree",
    as_json: JsonOption = False,
) -> None:
    """Parse `files` and print their trees."""
    from stlc.cli.framework.spec_files import spec_files
    from stlc.cli.framework.tree_text import as_dot, as_tree, as_values

    names = spec_files(files)
    specs = _read(names)
    if as_json or layout == "json":
        trees = [{"file": name, "tree": as_values(spec)} for name, spec in zip(names, specs, strict=True)]
        emit_json("parse/1", ok=True, exit_code=0, result=trees[0] if len(trees) == 1 else {"files": trees})
    elif layout == "dot":
        emit(as_dot(specs))
    else:
        emit("\n\n".join(map(as_tree, specs)))


def _read(names: tuple[str, ...]) -> list[ast.Spec]:
    """All trees; the findings of all files that have none are raised together."""
    from stlc.files import read_source
    from stlc.grammar.parse.parser import parse as parse_text

    specs: list[ast.Spec] = []
    findings: list[Diagnostic] = []
    for name in names:
        try:
            specs.append(parse_text(read_source(name)))
        except SpecError as error:
            findings += error.diagnostics
    if findings:
        raise SpecError(*findings)
    return specs
