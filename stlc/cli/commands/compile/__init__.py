"""`stlc compile`: the compiled form of a specification, or its syntax tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic, SpecError, StlcError, usage
from stlc.files import File
from stlc.options import Options

if TYPE_CHECKING:
    from stlc.compile.described import CompiledSpec


@dataclass(frozen=True, slots=True)
class ParsedFile:
    """Syntax tree of a specification: kind of node and fields, as JSON."""

    file: str
    tree: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class ParsedFiles:
    """Syntax trees of several specifications."""

    files: Sequence[ParsedFile]


Part = Literal["all", "steps", "states", "ir", "ast", "dot"]


@command(
    "stlc compile specs/traffic.stl",
    "stlc compile specs/traffic.stl --system car.yaml --set T_red=3s --show ir",
    "stlc compile specs/traffic.stl --show dot | dot -Tsvg > traffic.svg",
)
def compile_(
    files: Annotated[
        list[str], typer.Argument(metavar="SPEC", help="The specification; for ast and dot several, or -.")
    ],
    system: Options.System = None,
    set_: Options.Overrides = Options.NONE,
    show: Annotated[
        Part, typer.Option("--show", metavar="PART", help="all, steps, states, ir, ast, or dot.")
    ] = "all",
    watch: Annotated[bool, typer.Option("--watch", help="Compile again whenever a file changes.")] = False,
    json: JsonOption = False,
) -> Answer[CompiledSpec | ParsedFile | ParsedFiles]:
    """Show the compiled form of a specification, or its syntax tree.

    The compiled form lists the intervals of the temporal operators in seconds and in steps, the states that
    the specification adds to the system, the requirements tagged @safety, and the horizon. --show ast prints
    the syntax tree, and --show dot prints it as a graph for Graphviz. Both check only the syntax; `stlc lint`
    also checks names, types and units.
    """
    if show == "ast" or show == "dot":
        from stlc.files import File

        return _trees(File.specs(files), show)
    if len(files) > 1:
        advice = ("stlc compile SPEC", "stlc compile SPEC SPEC --show ast")
        raise usage("one specification is compiled at a time", *advice)
    spec = Path(files[0])
    if not watch:
        return _compiled(spec, system, set_, show)
    from stlc.cli.framework.watch import watch as watch_files

    watch_files(
        _files(spec, system),
        lambda: _compiled(spec, system, set_, show).print("compile/1", as_json=json),
    )
    raise typer.Exit


def _trees(names: Sequence[str], show: Literal["ast", "dot"]) -> Answer[ParsedFile | ParsedFiles]:
    """Return the answer of `stlc compile` that shows the syntax trees of the specification files `names`.

    If `show` is "ast", the trees are printed as indented text. If it is "dot", they are printed as a graph
    for Graphviz. The syntax errors of all files are raised together.
    """
    from stlc.cli.commands.compile.tree_text import as_dot, as_tree, as_values
    from stlc.grammar.spec import Spec

    specs, findings = [], list[Diagnostic]()
    for name in names:
        try:
            specs.append(Spec.parse(File(name).read()))
        except SpecError as error:
            findings += error.diagnostics
    if findings:
        raise SpecError(*findings)
    trees = [ParsedFile(name, as_values(spec)) for name, spec in zip(names, specs, strict=True)]
    return Answer(
        trees[0] if len(trees) == 1 else ParsedFiles(trees),
        lambda: emit(as_dot(specs) if show == "dot" else "\n\n".join(map(as_tree, specs))),
    )


def _files(spec: Path, system: str | None) -> list[str]:
    """Files to watch: the specification, and the system file if there is one."""
    from stlc.grammar.spec import Spec

    spec = File(spec).spec()
    try:
        wanted = system or Spec.parse(File(spec).read()).system
        return [str(spec), *([str(File(wanted).system(spec))] if wanted else [])]
    except StlcError:
        return [str(spec)]


def _compiled(
    path: Path,
    system: str | None,
    overrides: Mapping[str, str],
    show: Literal["all", "steps", "states", "ir"],
) -> Answer[CompiledSpec]:
    """Compile the specification `path` for a system, without importing torch; print the part `show`.

    `system` is the system file of `--system`. The specification is compiled for recorded traces if the system
    file names it as the judge of closed-loop runs.
    """
    from stlc.compile.described import CompiledSpec
    from stlc.compile.dump import dump
    from stlc.compile.ir.discretize import Grid
    from stlc.compile.pipeline import Purpose, compile_spec
    from stlc.dynamics.load import load_system_decl
    from stlc.grammar.spec import Spec

    path = File(path).spec()
    spec = Spec.parse(File(path).read())
    wanted = system or spec.system
    if wanted is None:
        help_ = (f"stlc compile {path} --system FILE", 'or a line `system "FILE"` in the specification')
        raise usage(f"`{path}` names no system", *help_)
    decl = load_system_decl(File(wanted).system(path), overrides)
    purpose: Purpose = "check" if decl.judges_by(path) else "train"
    grid = Grid(decl.dt, decl.horizon)
    compiled = compile_spec(spec, grid=grid, interface=decl.interface(), overrides=overrides, purpose=purpose)

    def tell() -> None:
        say(f"system {decl.path}")
        show_diagnostics(compiled.warnings)
        emit(dump(compiled, show).rstrip("\n"))

    return Answer(
        CompiledSpec.of(compiled, str(decl.path), decl.signature.names), tell, diagnostics=compiled.warnings
    )
