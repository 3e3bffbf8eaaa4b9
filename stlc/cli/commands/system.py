"""`stlc system`: show, validate and list system files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.cli.framework.output import Answer, emit, say, show_diagnostics, table
from stlc.cli.framework.program import group, subcommand
from stlc.escape import visible
from stlc.files import File
from stlc.options import Options

if TYPE_CHECKING:
    from stlc.diagnostics import Diagnostic
    from stlc.dynamics.crosscheck import Comparison
    from stlc.dynamics.declaration.decl import SystemDecl
    from stlc.dynamics.facts import ListedSystem, SystemFacts, SystemList

_File = Annotated[
    str, typer.Argument(metavar="SYSTEM", help="As given, in systems/, in examples/, or installed.")
]


GROUP = group("Show, check and list system files.", "stlc system show car.yaml")


@subcommand(GROUP, "show", "stlc system show car.yaml")
def show(system: _File, set_: Options.Overrides = Options.NONE) -> Answer[SystemFacts]:
    """Show the declarations of a system file, from states to scenarios."""
    from stlc.dynamics.facts import SystemFacts

    decl = _load(system, set_)

    def tell() -> None:
        say(f"system {decl.path}")
        show_diagnostics(decl.warnings)
        emit(decl.describe())

    return Answer(SystemFacts(decl), tell, diagnostics=decl.warnings)


@subcommand(GROUP, "check", "stlc system check car.yaml", "stlc system check examples/car.yaml --steps 64")
def check(
    system: _File,
    steps: Annotated[
        int, typer.Option(min=0, help="Steps of the rollouts; with 0 the file is only read.")
    ] = 32,
    seed: Options.Seed = 0,
    set_: Options.Overrides = Options.NONE,
) -> Answer[SystemFacts]:
    """Validate a system file with random rollouts.

    With --steps 0 the file is only read, without torch. Otherwise, random rollouts are simulated. They detect
    dynamics that diverge, and conditions in the section `init` that reject nearly all states. Kinematics from
    a URDF are compared with pytorch-kinematics if that is installed.
    """
    from stlc.dynamics.facts import DrivenSteps, SystemFacts

    decl = _load(system, set_)
    warnings = _roll_out(decl, steps, seed) if steps else decl.warnings
    compared: list[Comparison] = []
    robots = [function for function in decl.functions if function.body is not None]
    if steps and robots:
        from stlc.dynamics import crosscheck

        compared = [crosscheck.compared(function) for function in robots]

    def tell() -> None:
        show_diagnostics(warnings)
        for one in compared:
            if one.distance is None:
                say(f"{one.name}: not compared; {one.why}")
            else:
                say(f"{one.name}: within {one.distance:.1e} m of pytorch-kinematics in 256 random positions")
        ran = f", {steps} steps from {_DRAWN} starts" if steps else ""
        size = f"{_counted(len(decl.signature), 'state')}, {_counted(len(decl.controls), 'control')}"
        emit(f"{visible(str(decl.path))} is valid: {size}{ran}")

    result = SystemFacts(decl, DrivenSteps(steps, seed), tuple(compared))
    return Answer(result, tell, diagnostics=warnings)


@subcommand(GROUP, "list", "stlc system list")
def list_() -> Answer[SystemList]:
    """List the systems that are found by name."""
    from stlc.dynamics.facts import SystemList

    found = list(_all_systems())

    def tell() -> None:
        if found:
            rows = [(each.name, each.path, each.doc) for each in found]
            emit(table(rows, header=("name", "file", "")))
        else:
            say("no system here; write one: stlc init --system cart")

    return Answer(SystemList(tuple(found)), tell)


_DRAWN = 256


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _load(name: str, overrides: Mapping[str, str]) -> SystemDecl:
    from stlc.dynamics.load import load_system_decl

    return load_system_decl(File(name).system(), overrides)


def _roll_out(decl: SystemDecl, steps: int, seed: int) -> tuple[Diagnostic, ...]:
    """Simulate random initial states under random controls for `steps` steps; return all warnings.

    Raises SystemFileError if no initial states can be sampled, if a simulated state is not finite, or if the
    errors of a listed constant cannot be carried (S212) or have no effect (S213).
    """
    import torch

    from stlc.dynamics.declaration.perturbable import perturbable
    from stlc.dynamics.system import System

    if decl.test.uncertain is not None:
        perturbable(decl)
    system = System(decl)
    warnings = system.probe(_DRAWN, seed=seed)
    low, high = system.control_low, system.control_high
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand((_DRAWN, steps, len(system.decl.controls)), generator=generator)
    with torch.no_grad():
        system.require_finite(system.rollout(system.sample(_DRAWN, seed=seed), low + share * (high - low)))
    return warnings


def _all_systems() -> Iterator[ListedSystem]:
    """Yield a record of every system file in the search path: name, path, and description or first error."""
    from stlc.diagnostics import StlcError
    from stlc.dynamics.facts import ListedSystem
    from stlc.dynamics.load import load_system_decl

    seen: set[str] = set()
    for folder in (Path("systems"), Path("examples"), File.SYSTEMS):
        for path in sorted([*folder.glob("*.yaml"), *folder.glob("*.yml")]):
            if path.name in seen:
                continue
            seen.add(path.name)
            try:
                decl = load_system_decl(path)
            except StlcError as error:
                finding = error.diagnostics[0]
                invalid = f"invalid: {finding.code}, {finding.message}"
                yield ListedSystem(path.stem, str(path), invalid)
            else:
                yield ListedSystem(decl.name, str(path), decl.doc)
