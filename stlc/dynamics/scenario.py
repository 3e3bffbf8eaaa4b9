"""A scenario laid over a system: what is different in it, and for whom."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from stlc.diagnostics import Diagnostic, UsageError
from stlc.dynamics.decl import ScenarioDecl, SystemDecl
from stlc.dynamics.schema import load_system_decl, parse_system
from stlc.registry import closest


def find_scenario(decl: SystemDecl, name: str) -> ScenarioDecl:
    """The overlay of that name. Raises UsageError (U101)."""
    for scenario in decl.scenarios:
        if scenario.name == name:
            return scenario
    names = [scenario.name for scenario in decl.scenarios]
    near = closest(name, names)
    listed = f"scenarios of {decl.name}: {', '.join(names)}" if names else f"{decl.name} declares none"
    help_ = (f"did you mean `{near}`?  {listed}" if near else listed,)
    raise UsageError(Diagnostic("U101", f"there is no scenario `{name}`", help=help_))


def scenario_constants(path: Path, name: str, overrides: Mapping[str, str]) -> Mapping[str, str]:
    """What a scenario of a system file says about constants: specification and model change together."""
    return find_scenario(load_system_decl(path, overrides), name).constants


def under(decl: SystemDecl, name: str) -> SystemDecl:
    """The system under a scenario: what agents start from and meet; its model stays, but for constants.

    Raises UsageError (U101) where there is no such scenario.
    """
    scenario = find_scenario(decl, name)
    return _laid_over(_with_constants(decl, scenario.constants) if scenario.constants else decl, name)


def truth(decl: SystemDecl) -> SystemDecl:
    """The system as it is where its scenario says that the model is mistaken."""
    scenario = decl.scenario
    if scenario is None or not scenario.mismatch:
        return decl
    return _laid_over(_with_constants(decl, scenario.mismatch), scenario.name)


def _laid_over(decl: SystemDecl, name: str) -> SystemDecl:
    scenario = find_scenario(decl, name)
    init = replace(decl.init, override=(*decl.init.override, *scenario.override))
    events = (*decl.test.events, *scenario.events)
    test = replace(decl.test, events=events, world=scenario.world or decl.test.world)
    return replace(decl, init=init, test=test, scenario=scenario)


def _with_constants(decl: SystemDecl, constants: Mapping[str, str]) -> SystemDecl:
    return parse_system(decl.source, decl.path, {**decl.overrides, **constants})
