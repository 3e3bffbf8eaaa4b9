"""Scenarios: named changes of a system for deployment.

Every system has three standard scenarios, whose size in percent may follow the name, as in `mismatch-20`:
`mismatch` of the numbers in the dynamics and of the actuator gains, `disturb` of the controls, and `noise` on
the measured states.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from stlc.diagnostics import usage
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.deployment import ErrorsDecl, ScenarioDecl
from stlc.dynamics.load import load_system_decl, parse_system
from stlc.source import Source

DISTURBED = ("mismatch-5", "mismatch-10", "mismatch-20", "disturb", "noise")
"""Standard scenarios that the documentation measures."""
_STANDARD = re.compile(r"(mismatch|disturb|noise)(?:-(\d{1,3}(?:\.\d{1,3})?))?")
_USUAL = {"mismatch": 10.0, "disturb": 10.0, "noise": 0.5}
"""Percentages of standard scenarios whose name gives none."""
_MISMATCH = "actuators and numbers of the dynamics are {:g} % more or less than the model says"
_ERRORS = {
    "mismatch": (_MISMATCH, ("actuator_gain", "parameters")),
    "disturb": ("noise on what actuators give, {:g} % of half their range", ("actuator_noise",)),
    "noise": ("noise on what agents see, {:g} % of the range of each state", ("sensor_noise",)),
}
"""Description of a standard scenario, and the errors that it sets."""


def standard(name: str) -> ScenarioDecl | None:
    """Return the standard scenario called `name`, such as `mismatch-20`; None for any other name.

    The number is the size of the errors in percent; it may be omitted.
    """
    found = _STANDARD.fullmatch(name)
    if found is None:
        return None
    doc, errors = _ERRORS[found[1]]
    percent = float(found[2] or _USUAL[found[1]])
    if not 0.0 < percent <= 100.0:
        return None
    shares = ErrorsDecl(**dict.fromkeys(errors, percent / 100))
    return ScenarioDecl(name, doc.format(percent), "ood", errors=shares)


def find_scenario(decl: SystemDecl, name: str, *advice: str) -> ScenarioDecl:
    """Return the scenario called `name`, from the file or a standard one.

    Raises UsageError (U101), with `advice` added, if there is no such scenario.
    """
    for scenario in decl.scenarios:
        if scenario.name == name:
            return scenario
    if (usual := standard(name)) is not None:
        return usual
    names = [scenario.name for scenario in decl.scenarios]
    listed = f"scenarios of {decl.name}: {', '.join(names)}" if names else f"{decl.name} declares none"
    every = f"every system has {', '.join(DISTURBED)}"
    missing = usage(f"there is no scenario `{name}`", every, *advice)
    raise missing.near(name, [*names, *DISTURBED, "mismatch"], listed=listed)


def scenario_constants(
    path: Path | Source, name: str, overrides: Mapping[str, str], *advice: str
) -> Mapping[str, str]:
    """Return the constants that the scenario `name` of the system file `path` changes: name -> new value.

    The new value is a text. The constants change in the specification as well as in the system. `advice`: see
    `find_scenario`.
    """
    return find_scenario(load_system_decl(path, overrides), name, *advice).constants


def under(decl: SystemDecl, name: str) -> SystemDecl:
    """Return the declaration with the scenario called `name` applied.

    The constants (`const`) of the scenario change the model with which controls are planned. Its model
    mismatch does not: it changes only the true system (see `truth`).

    Raises UsageError (U101) if the scenario does not exist.
    """
    scenario = find_scenario(decl, name)
    return _laid_over(_with_constants(decl, scenario.constants) if scenario.constants else decl, name)


def truth(decl: SystemDecl) -> SystemDecl:
    """Return the true system, which may differ from the model with which controls are planned.

    It is the declaration `decl` with the model mismatch of its scenario. If the scenario has no mismatch, it
    is `decl` itself.
    """
    scenario = decl.scenario
    if scenario is None or not scenario.mismatch:
        return decl
    real = replace(_with_constants(decl, scenario.mismatch), controls=decl.controls, feedback=decl.feedback)
    return _laid_over(real, scenario.name)


def _laid_over(decl: SystemDecl, name: str) -> SystemDecl:
    scenario = find_scenario(decl, name)
    init = replace(decl.init, override=(*decl.init.override, *scenario.override))
    events = (*decl.test.events, *scenario.events)
    world, judge = scenario.world or decl.test.world, scenario.judge or decl.test.judge
    test = replace(decl.test, events=events, world=world, judge=judge)
    objective = replace(decl.objective, terms=(*decl.objective.terms, *scenario.prefer))
    backup = scenario.backup or decl.backup
    return replace(decl, init=init, test=test, objective=objective, backup=backup, scenario=scenario)


def _with_constants(decl: SystemDecl, constants: Mapping[str, str]) -> SystemDecl:
    return parse_system(decl.source, decl.path, {**decl.overrides, **constants})
