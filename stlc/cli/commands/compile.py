"""`stlc compile`: the compiled form of a specification, or its syntax tree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stlc.cli.framework import documents
from stlc.cli.framework.options import JsonOption, SetOption, SystemOption, parse_overrides, spec_files
from stlc.cli.framework.output import Answer, emit, say, show_diagnostics
from stlc.cli.framework.program import command

if TYPE_CHECKING:
    from stlc.compile.pipeline import Compiled, CompiledRequirement
    from stlc.dynamics.declaration.decl import SystemDecl

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
    system: SystemOption = None,
    set_: SetOption = None,
    show: Annotated[
        Part, typer.Option("--show", metavar="PART", help="all, steps, states, ir, ast, or dot.")
    ] = "all",
    watch: Annotated[bool, typer.Option("--watch", help="Compile again whenever a file changes.")] = False,
    json: JsonOption = False,
) -> Answer[documents.CompileResult]:
    """Show the compiled form of a specification, or its syntax tree.

    The compiled form lists the intervals of the temporal operators in seconds and in steps, the states that
    the specification adds to the system, the requirements tagged @safety, and the horizon. --show ast prints
    the syntax tree, and --show dot prints it as a graph for Graphviz. Both check only the syntax; `stlc lint`
    also checks names, types and units.
    """
    from stlc.diagnostics import usage

    if show == "ast" or show == "dot":
        return _trees(spec_files(files), show)
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


def _trees(
    names: Sequence[str], show: Literal["ast", "dot"]
) -> Answer[documents.ParsedFile | documents.ParsedFiles]:
    """Return the answer of `stlc compile` that shows the syntax trees of the specification files `names`.

    If `show` is "ast", the trees are printed as indented text. If it is "dot", they are printed as a graph
    for Graphviz. The syntax errors of all files are raised together.
    """
    from stlc.cli.framework.tree_text import as_dot, as_tree, as_values
    from stlc.diagnostics import Diagnostic, SpecError
    from stlc.files import read_source
    from stlc.grammar.parse.parser import parse

    specs, findings = [], list[Diagnostic]()
    for name in names:
        try:
            specs.append(parse(read_source(name)))
        except SpecError as error:
            findings += error.diagnostics
    if findings:
        raise SpecError(*findings)
    trees: list[documents.ParsedFile] = [
        {"file": name, "tree": as_values(spec)} for name, spec in zip(names, specs, strict=True)
    ]
    return Answer(
        trees[0] if len(trees) == 1 else {"files": trees},
        lambda: emit(as_dot(specs) if show == "dot" else "\n\n".join(map(as_tree, specs))),
    )


def _files(spec: Path, system: str | None) -> list[str]:
    """Files to watch: the specification, and the system file if there is one."""
    from stlc.diagnostics import StlcError
    from stlc.files import find_spec, find_system, read_source
    from stlc.grammar.parse.parser import parse

    spec = find_spec(spec)
    try:
        wanted = system or parse(read_source(spec)).system
        return [str(spec), *([str(find_system(wanted, spec))] if wanted else [])]
    except StlcError:
        return [str(spec)]


def _compiled(
    path: Path,
    system: str | None,
    set_: list[str] | None,
    show: Literal["all", "steps", "states", "ir"],
) -> Answer[documents.CompiledSpec]:
    """Compile the specification `path` for a system, without importing torch; print the part `show`.

    `system` is the system file of `--system`, and `set_` are the values of `--set`. The specification is
    compiled for recorded traces if the system file names it as the judge of closed-loop runs.
    """
    from stlc.compile.dump import dump
    from stlc.compile.ir.discretize import Grid
    from stlc.compile.pipeline import Purpose, compile_spec
    from stlc.diagnostics import usage
    from stlc.dynamics.declaration.load import load_system_decl
    from stlc.files import find_spec, find_system, read_source
    from stlc.grammar.parse.parser import parse

    overrides = parse_overrides(set_)
    path = find_spec(path)
    spec = parse(read_source(path))
    wanted = system or spec.system
    if wanted is None:
        help_ = (f"stlc compile {path} --system FILE", 'or a line `system "FILE"` in the specification')
        raise usage(f"`{path}` names no system", *help_)
    decl = load_system_decl(find_system(wanted, path), overrides)
    purpose: Purpose = "check" if decl.judges_by(path) else "train"
    grid = Grid(decl.dt, decl.horizon)
    compiled = compile_spec(spec, grid=grid, interface=decl.interface(), overrides=overrides, purpose=purpose)

    def tell() -> None:
        say(f"system {decl.path}")
        show_diagnostics(compiled.warnings)
        emit(dump(compiled, show).rstrip("\n"))

    return Answer(_record(compiled, decl), tell, diagnostics=compiled.warnings)


def _record(compiled: Compiled, decl: SystemDecl) -> documents.CompiledSpec:
    from stlc.provenance import sha256

    steps = compiled.grid.horizon or 0
    source = compiled.spec.source
    added: list[documents.AddedState] = [
        {
            "name": each.column.name,
            "kind": "param",
            "initial": None,
            "range": [each.column.low, each.column.high],
            "about": f"{each.text}, drawn for every trajectory",
        }
        for each in compiled.parameters
    ]
    added += [
        {
            "name": timer.name,
            "kind": timer.kind,
            "initial": timer.initial,
            "range": [timer.low, timer.high],
            "about": timer.about,
        }
        for timer in compiled.timers
    ]
    return {
        "spec": source.name,
        "spec_sha256": sha256(source.text),
        "system": str(decl.path),
        "dt": float(decl.dt),
        "horizon": {"seconds": float(decl.dt * steps), "steps": steps},
        "states": [*decl.signature.names, *(state["name"] for state in added)],
        "added": added,
        "safety": [rule.name for rule in compiled.safety],
        "requirements": [_requirement(rule, float(decl.dt)) for rule in compiled.requirements],
    }


def _requirement(rule: CompiledRequirement, dt: float) -> documents.RequirementInSteps:
    return {
        "name": rule.name,
        "doc": rule.doc,
        "tags": sorted(rule.tags),
        "weight": rule.weight,
        "scale": rule.scale,
        "reach": {"seconds": rule.reach * dt, "steps": rule.reach},
        "intervals": list(_intervals(rule, dt)),
    }


def _intervals(rule: CompiledRequirement, dt: float) -> Iterator[documents.WrittenInterval]:
    """Yield a record of each interval of a temporal operator in the requirement `rule`.

    The ends of the interval are given in seconds and in steps. If the upper end is None, the interval extends
    to the end of the trace. `dt` is the time step in seconds.
    """
    from stlc.compile.ir import nodes as ir
    from stlc.compile.ir.traverse import nodes

    for node in nodes(rule.formula):
        if not isinstance(node, ir.Windowed):
            continue
        steps = [node.window.lo, node.window.hi]
        yield {
            "operator": node.op,
            "steps": steps,
            "seconds": [None if step is None else step * dt for step in steps],
            "written": node.span.text if node.span else "",
            "line": node.span.line if node.span else None,
        }
