"""Synthesis, monitoring and guarding of controllers from Signal Temporal Logic specifications.

The names of the library are imported when they are first used:

    spec = stlc.load("specs/traffic.stl")
    verdict = stlc.check(spec, "trace.npz")

    task = stlc.compile(spec, stlc.System.load("examples/car.yaml"))
    run = stlc.train(task, budget=60)
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from stlc.extras import explained
from stlc.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from stlc.assurance.verification.tubes import tube
    from stlc.controller.problem.task import Task
    from stlc.controller.run.run import Run
    from stlc.controller.search.planner import PlanResult, plan
    from stlc.diagnostics import SpecError, StlcError
    from stlc.dynamics.system import System
    from stlc.grammar import ast
    from stlc.monitor.check import check
    from stlc.monitor.judgement import RequirementVerdict, Verdict
    from stlc.monitor.verdict import Monitor
    from stlc.trace import Trace
    from stlc.view.plotted import plot
    from stlc.view.trained import train

    def compile(spec: ast.Spec, system: System) -> Task:
        """Compile a specification for a system; see `_CallablePackage.__call__`.

        At run time, this name is the package `stlc.compile`, which can be called like a function.
        """

else:
    import stlc.compile as compile

__all__ = [
    "Monitor",
    "PlanResult",
    "RequirementVerdict",
    "Run",
    "SpecError",
    "StlcError",
    "System",
    "Task",
    "Trace",
    "Verdict",
    "__version__",
    "check",
    "compile",
    "load",
    "parse",
    "plan",
    "plot",
    "train",
    "tube",
]

_HOMES = {
    "Monitor": "stlc.monitor.verdict:Monitor",
    "PlanResult": "stlc.controller.search.planner:PlanResult",
    "RequirementVerdict": "stlc.monitor.judgement:RequirementVerdict",
    "Run": "stlc.controller.run.run:Run",
    "SpecError": "stlc.diagnostics:SpecError",
    "StlcError": "stlc.diagnostics:StlcError",
    "System": "stlc.dynamics.system:System",
    "Task": "stlc.controller.problem.task:Task",
    "Trace": "stlc.trace:Trace",
    "Verdict": "stlc.monitor.judgement:Verdict",
    "check": "stlc.monitor.check:check",
    "plan": "stlc.controller.search.planner:plan",
    "plot": "stlc.view.plotted:plot",
    "train": "stlc.view.trained:train",
    "tube": "stlc.assurance.verification.tubes:tube",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'stlc' has no attribute '{name}'")
    module, _, attribute = _HOMES[name].partition(":")
    with explained():
        value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def load(path: Path | str) -> ast.Spec:
    """Read and parse a specification file.

    Its path is stored in the result, because a system that the specification names is looked for beside it.

    Raises:
        UsageError: U102, there is no such file.
        SpecError: the text is not a specification; the error carries all diagnostics.
    """
    from stlc.files import find_spec, read_source
    from stlc.grammar.parser import parse as parse_source

    return parse_source(read_source(find_spec(path)))


def parse(text: str, name: str = "<text>") -> ast.Spec:
    """Parse the text of a specification; `name` names the text in messages. Raises SpecError."""
    from stlc.grammar.parser import parse as parse_source
    from stlc.source import Source

    return parse_source(Source(name, text))


class _CallablePackage(ModuleType):
    """Class of the package `stlc.compile`, which makes the package callable as a function.

    Python looks up `__call__` in the class of an object, so the package gets this class.
    """

    def __call__(self, spec: ast.Spec, system: System) -> Task:
        """Compile the specification for the system; return the task, for training, planning and simulation.

        The states of the system are extended by the timers that the specification needs.

        Raises:
            SpecError: the specification is invalid, or does not fit the system.
            NotInstalledError: R301, the extra `train` is not installed.
        """
        with explained():
            from stlc.controller.problem.task import Task

        return Task.of(spec, system)


compile.__class__ = _CallablePackage
