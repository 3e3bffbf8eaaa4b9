"""Synthesis, monitoring and guarding of controllers from Signal Temporal Logic specifications.

The names of the library are imported when they are first used:

    spec = stlc.load("specs/traffic.stl")
    verdict = stlc.check(spec, "trace.npz")

    task = stlc.compile(spec, stlc.System.load("examples/car.yaml"))
    run = stlc.train(task, budget=60)
"""

from __future__ import annotations

import inspect
import sys
from importlib import import_module
from operator import attrgetter
from types import ModuleType
from typing import TYPE_CHECKING, Any

from stlc.extras import explained
from stlc.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from stlc.assurance.certificates import certify
    from stlc.assurance.falsification import falsify
    from stlc.assurance.verification.tubes import tube
    from stlc.assurance.verification.verified import verify
    from stlc.controller.explain import explain
    from stlc.controller.problem.task import Task
    from stlc.controller.run.run import Run
    from stlc.controller.search.planner import PlanResult, plan
    from stlc.diagnostics import SpecError, StlcError
    from stlc.dynamics.system import System
    from stlc.export.targets import export
    from stlc.grammar.spec import Spec
    from stlc.monitor.check import check
    from stlc.monitor.judgement import RequirementVerdict, Verdict
    from stlc.monitor.linted import lint
    from stlc.monitor.verdict import Monitor
    from stlc.tabular import plot
    from stlc.trace import Trace
    from stlc.view.report import report
    from stlc.view.simulated import simulate
    from stlc.view.trained import train

    compile = Task.of
else:
    import stlc.compile as compile
    import stlc.export as export
    import stlc.lint as lint

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
    "certify",
    "check",
    "compile",
    "explain",
    "export",
    "falsify",
    "lint",
    "load",
    "parse",
    "plan",
    "plot",
    "report",
    "simulate",
    "train",
    "tube",
    "verify",
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
    "certify": "stlc.assurance.certificates:certify",
    "check": "stlc.monitor.check:check",
    "explain": "stlc.controller.explain:explain",
    "falsify": "stlc.assurance.falsification:falsify",
    "plan": "stlc.controller.search.planner:plan",
    "plot": "stlc.tabular:plot",
    "report": "stlc.view.report:report",
    "simulate": "stlc.view.simulated:simulate",
    "train": "stlc.view.trained:train",
    "tube": "stlc.assurance.verification.tubes:tube",
    "verify": "stlc.assurance.verification.verified:verify",
}
_CALLED = {
    "stlc.compile": "stlc.controller.problem.task:Task.of",
    "stlc.export": "stlc.export.targets:export",
    "stlc.lint": "stlc.monitor.linted:lint",
}
"""Packages that can be called like the function that has their name."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'stlc' has no attribute '{name}'")
    value = globals()[name] = _found(_HOMES[name])
    return value


def _found(place: str) -> Any:
    """Import what is at `module:name`."""
    module, _, attribute = place.partition(":")
    with explained():
        return attrgetter(attribute)(import_module(module))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def load(path: Path | str) -> Spec:
    """Read and parse a specification file.

    Its path is stored in the result, because a system that the specification names is looked for beside it.

    Raises:
        UsageError: U102, there is no such file.
        SpecError: the text is not a specification; the error carries all diagnostics.
    """
    from stlc.grammar.spec import Spec

    return Spec.load(path)


def parse(text: str, name: str = "<text>") -> Spec:
    """Parse the text of a specification; `name` names the text in messages. Raises SpecError."""
    from stlc.grammar.spec import Spec
    from stlc.source import Source

    return Spec.parse(Source(name, text))


class _CallablePackage(ModuleType):
    """Class of a package that is called as a function: Python looks up `__call__` in classes."""

    def __call__(self, *given: Any, **options: Any) -> Any:
        """Call the function of the package's name."""
        return _found(_CALLED[self.__name__])(*given, **options)

    @property
    def __signature__(self) -> inspect.Signature:
        """Signature of this function, for notebooks and `help`."""
        return inspect.signature(_found(_CALLED[self.__name__]))


for _name in _CALLED:
    sys.modules[_name].__class__ = _CallablePackage
