"""`stlc compile`: the compiled form of a specification, or its syntax tree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stlc.cli.framework.options import JsonOption, SetOption, SystemOption, parse_overrides, spec_files
from stlc.cli.framework.output import emit, emit_json, say, show_diagnostics
from stlc.cli.framework.program import command

if TYPE_CHECKING:
    from stlc.compile.augment.timers import Timer
    from stlc.compile.ir import typed
    from stlc.compile.pipeline import Compiled, CompiledRequirement
    from stlc.dynamics.declaration.decl import SystemDecl
    from stlc.grammar import ast

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
    as_json: JsonOption = False,
) -> None:
    """Show the compiled form of a specification, or its syntax tree.

    Intervals in seconds and in steps, added states, the safety part, the horizon. --show ast prints the
    syntax tree, --show dot the same for Graphviz; both check only the syntax, `stlc lint` also names, types
    and units.
    """
    from stlc.diagnostics import Diagnostic, StlcError, UsageError

    if show == "ast" or show == "dot":
        _trees(spec_files(files), show, as_json=as_json)
        return
    if len(files) > 1:
        help_ = ("stlc compile SPEC", "stlc compile SPEC SPEC --show ast")
        raise UsageError(Diagnostic("U101", "one specification is compiled at a time", help=help_))
    spec = Path(files[0])
    if not watch:
        _show(spec, system, set_, show, as_json=as_json)
        return
    from stlc.cli.framework.watch import watch as watch_files

    def again() -> None:
        try:
            _show(spec, system, set_, show, as_json=as_json)
        except StlcError as error:
            show_diagnostics(error.diagnostics)

    watch_files(_files(spec, system), again)


def _trees(names: Sequence[str], show: Part, *, as_json: bool) -> None:
    """Print syntax trees; the syntax errors of all files are raised together."""
    from stlc.cli.framework.tree_text import as_dot, as_tree, as_values
    from stlc.diagnostics import Diagnostic, SpecError
    from stlc.files import read_source
    from stlc.grammar.parse.parser import parse

    specs: list[ast.Spec] = []
    findings: list[Diagnostic] = []
    for name in names:
        try:
            specs.append(parse(read_source(name)))
        except SpecError as error:
            findings += error.diagnostics
    if findings:
        raise SpecError(*findings)
    if as_json:
        trees = [{"file": name, "tree": as_values(spec)} for name, spec in zip(names, specs, strict=True)]
        emit_json("compile/1", ok=True, exit_code=0, result=trees[0] if len(trees) == 1 else {"files": trees})
    else:
        emit(as_dot(specs) if show == "dot" else "\n\n".join(map(as_tree, specs)))


def _files(spec: Path, system: str | None) -> list[str]:
    """The files to watch: the specification, and the system file if it is found."""
    from stlc.diagnostics import StlcError
    from stlc.files import find_spec, find_system, read_source
    from stlc.grammar.parse.parser import parse

    spec = find_spec(spec)
    try:
        wanted = system or parse(read_source(spec)).system
        return [str(spec), *([str(find_system(wanted, spec))] if wanted else [])]
    except StlcError:
        return [str(spec)]


def _show(
    spec: Path,
    system: str | None,
    set_: list[str] | None,
    show: Literal["all", "steps", "states", "ir"],
    *,
    as_json: bool,
) -> None:
    from stlc.compile.dump import dump

    compiled, decl = _compiled(spec, system, parse_overrides(set_))
    if as_json:
        result = _result(compiled, decl)
        emit_json("compile/1", ok=True, exit_code=0, diagnostics=compiled.warnings, result=result)
        return
    say(f"system {decl.path}")
    show_diagnostics(compiled.warnings)
    emit(dump(compiled, show).rstrip("\n"))


def _compiled(path: Path, system: str | None, overrides: Mapping[str, str]) -> tuple[Compiled, SystemDecl]:
    """Read both files and run the compiler; torch is not needed.

    A specification that judges closed-loop runs of its system is compiled for recorded traces.
    """
    from stlc.compile.ir.discretize import Grid
    from stlc.compile.pipeline import Purpose, compile_spec
    from stlc.diagnostics import Diagnostic, UsageError
    from stlc.dynamics.declaration.load import load_system_decl
    from stlc.files import find_spec, find_system, read_source
    from stlc.grammar.parse.parser import parse

    path = find_spec(path)
    spec = parse(read_source(path))
    wanted = system or spec.system
    if wanted is None:
        raise UsageError(
            Diagnostic(
                "U101",
                f"`{path}` names no system",
                help=(f"stlc compile {path} --system FILE", 'or a line `system "FILE"` in the specification'),
            )
        )
    decl = load_system_decl(find_system(wanted, path), overrides)
    grid = Grid(decl.dt, decl.horizon)
    interface = decl.interface()
    purpose: Purpose = "check" if decl.judges_by(path) else "train"
    return compile_spec(spec, grid=grid, interface=interface, overrides=overrides, purpose=purpose), decl


def _result(compiled: Compiled, decl: SystemDecl) -> dict[str, Any]:
    from stlc.provenance import sha256

    steps = compiled.grid.horizon or 0
    source = compiled.spec.source
    added = [*map(_parameter, compiled.parameters), *map(_added, compiled.timers)]
    return {
        "spec": source.name,
        "spec_sha256": sha256(source.text),
        "system": str(decl.path),
        "dt": float(decl.dt),
        "horizon": {"seconds": float(decl.dt * steps), "steps": steps},
        "states": [*decl.signature.names, *(item["name"] for item in added)],
        "added": added,
        "safety": [rule.name for rule in compiled.safety],
        "requirements": [_requirement(rule, float(decl.dt)) for rule in compiled.requirements],
    }


def _parameter(each: typed.Parameter) -> dict[str, Any]:
    """A parameter that the compiler adds to the state."""
    column = each.column
    return {
        "name": column.name,
        "kind": "param",
        "initial": None,
        "range": [column.low, column.high],
        "about": f"{each.text}, drawn for every trajectory",
    }


def _added(timer: Timer) -> dict[str, Any]:
    """A timer that the compiler adds to the state."""
    return {
        "name": timer.name,
        "kind": timer.kind,
        "initial": timer.initial,
        "range": [timer.low, timer.high],
        "about": timer.about,
    }


def _requirement(rule: CompiledRequirement, dt: float) -> dict[str, Any]:
    return {
        "name": rule.name,
        "doc": rule.doc,
        "tags": sorted(rule.tags),
        "weight": rule.weight,
        "scale": rule.scale,
        "reach": {"seconds": rule.reach * dt, "steps": rule.reach},
        "intervals": list(_intervals(rule, dt)),
    }


def _intervals(rule: CompiledRequirement, dt: float) -> Iterator[dict[str, Any]]:
    """The windows of a compiled formula; an upper end of None is the end of the trace."""
    from stlc.compile.ir import nodes as ir
    from stlc.compile.ir.traverse import nodes

    for node in nodes(rule.formula):
        if not isinstance(node, ir.Windowed):
            continue
        steps = (node.window.lo, node.window.hi)
        yield {
            "operator": node.op,
            "steps": steps,
            "seconds": [None if step is None else step * dt for step in steps],
            "written": node.span.text if node.span else "",
            "line": node.span.line if node.span else None,
        }
