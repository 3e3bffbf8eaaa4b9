"""Loading of tasks from a specification file and a system file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from stlc.controller.problem.task import Task
from stlc.diagnostics import usage
from stlc.dynamics.scenario import scenario_constants
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.parser import parse

HINT = "--system FILE"
"""Advice that most commands print if no system is named."""


def require_controls(task: Task, who: str = "a policy") -> None:
    """Raise UsageError (U101) if the system of a task has no control.

    `who` names, in the message, what would choose the controls: `a policy` or `a guard`.
    """
    if task.system.decl.controls:
        return
    message = f"the system `{task.system.decl.name}` has no control: {who} has nothing to choose"
    raise usage(
        message, "`stlc plan SPEC` judges it from random initial states", "control: {u: {range: [-1, 1]}}"
    )


def load_task(
    spec: Path | str,
    system: Path | str | None = None,
    overrides: Mapping[str, str] | None = None,
    *,
    hint: str = HINT,
    found: Callable[[Path], None] | None = None,
    scenario: str | None = None,
    whole: bool = False,
) -> Task:
    """Load a specification and a system, and compile the specification for the system.

    Args:
        spec: specification file, searched by `File.spec`.
        system: system file, which `File.system` looks for; by default the one that the specification names.
        overrides: constants of the specification and keys of the system file to change, name -> text.
        hint: what the user may do if no system is named.
        found: function that receives the path of the system file before it is read.
        scenario: name of a scenario of the system file to apply.
        whole: whether plans reach to the end of a deployment (`Task.of`).

    Raises:
        UsageError: U101, no system is named, or there is no such scenario; U102, there is no such file.
        SpecError: the specification is invalid or does not fit the system.
        SystemFileError: the system file is invalid.
    """
    path = File(spec).spec()
    parsed = parse(File(path).read())
    wanted = system if system is not None else parsed.system
    if wanted is None:
        raise usage(f"`{path}` names no system", hint, 'or a line `system "FILE"` in the specification')
    there = File(wanted).system(path)
    if found is not None:
        found(there)
    changed = dict(overrides or {})
    if scenario is not None:
        changed = {**scenario_constants(there, scenario, changed), **changed}
    found_system = System.load(there, changed, scenario=scenario)
    return Task.of(parsed, found_system, overrides=changed, whole=whole)
