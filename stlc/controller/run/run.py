"""A training run, finished or not: its folder, task and policy."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

from torch import Tensor, nn

from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.controller.run.checkpoint import load_checkpoint, weights
from stlc.controller.run.config import ResolvedConfig
from stlc.diagnostics import PluginError, RunError
from stlc.dynamics.load import load_system_decl
from stlc.dynamics.scenario import scenario_constants, under
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec, file_of
from stlc.plugins import variable
from stlc.registry import GUARDS, METHODS, PLANNERS, PackageRegistry
from stlc.rundir import RunDir
from stlc.tabular import html_table

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from stlc.controller.guard.loop import GuardedLoop
    from stlc.controller.policies.policy import PlanProposer, Policy
    from stlc.dynamics.declaration.decl import SystemDecl


@dataclass(frozen=True, slots=True)
class Run:
    """A training run: its folder, task and policy.

    Attributes:
        dir: folder of the run.
        task: problem that the policy was trained for.
        policy: the trained policy; a call with states (B, n) returns plans (B, T, m) in physical units.
    """

    dir: RunDir
    task: Task
    policy: Policy

    @classmethod
    def open(
        cls,
        where: Path | str = "latest",
        *,
        root: Path = RunDir.RUNS,
        device: str = "cpu",
        overrides: Mapping[str, str] | None = None,
        scenario: str | None = None,
    ) -> Run:
        """Load a run with its policy.

        `overrides` and `scenario` change the task, but not the policy.

        Args:
            where: folder, name or number of the run, or `latest`.
            root: folder of all runs.
            device: torch device of the policy.
            overrides: changed constants and fixed parameters, as with `--set`, name -> text.
            scenario: name of a scenario of the system file that is applied to the task.

        Raises:
            UsageError: the run does not exist.
            RunError: R101, the run is damaged or has no checkpoint yet; R102, its checkpoint belongs to
                another task.
            SpecError, SystemFileError: its specification or system is invalid.
        """
        folder = RunDir.open(where, root)
        task = Run.task_in(folder, overrides, scenario)
        config = load_config(folder)
        return cls(folder, task, METHODS.get(config.method).load(task, folder, config, device))

    @staticmethod
    def folder(run: Run | Path | str, runs: Path = RunDir.RUNS) -> RunDir:
        """Folder of a run, or of the one that is called so below `runs`; see `RunDir.open`."""
        return run.dir if isinstance(run, Run) else RunDir.open(run, runs)

    @staticmethod
    def task_in(
        folder: RunDir, overrides: Mapping[str, str] | None = None, scenario: str | None = None
    ) -> Task:
        """Compile the specification and the system in a run's folder.

        Plans reach to the end of a deployment (`Task.of`) as they did in the run.

        Args:
            folder: folder of the run, whose own `--set` changes are applied first.
            overrides: further changes, name -> text. A parameter that varied in training gets the given
                value. It remains an entry of the state, because the policy observes it.
            scenario: name of a scenario of the system file to apply.
        """
        trained = folder.record().get("overrides") or {}
        spec = replace(Spec.parse(folder.source(RunDir.SPEC)), library=folder.library())
        decl, changed = Run.declaration_in(folder, overrides, scenario), _changes(folder, overrides, scenario)
        drawn = {item.name for item in spec.parameters} - trained.keys()
        values = {name: text for name, text in changed.items() if name in drawn}
        constants = {name: text for name, text in changed.items() if name not in drawn}
        config = folder.read_json(RunDir.CONFIG) if folder.has(RunDir.CONFIG) else {}
        whole = isinstance(config, dict) and ("planner" in config or config.get("whole") is True)
        return Task.of(spec, System(decl), overrides=constants, values=values, whole=whole)

    @staticmethod
    def declaration_in(
        folder: RunDir, overrides: Mapping[str, str] | None = None, scenario: str | None = None
    ) -> SystemDecl:
        """Read the system in a run's folder. No code is run; the arguments are those of `task_in`."""
        decl = load_system_decl(folder.source(RunDir.SYSTEM), _changes(folder, overrides, scenario))
        return decl if scenario is None else under(decl, scenario)

    def __repr__(self) -> str:
        name = f"{self.dir.path.parent.name}/{self.dir.name}"
        result = self.dir.record().get("result") or {}
        told: str = self.dir.status
        if {"accuracy", "held_out"} <= {*result}:
            told = f"{result['accuracy']:.3f} of {result['held_out']:,} held-out starts"
        return f"Run({name}: {told})"

    def _repr_html_(self) -> str:
        found = (self.dir.record().get("result") or {}).get("requirements") or {}
        rows = [(name, f"{share:.1%}") for name, share in found.items()]
        return html_table(repr(self), ("requirement", "satisfied by plans"), rows)

    def guard(self, name: str = GUARDS.default) -> GuardedLoop:
        """Return a guard for a loop of one's own, which is called with a state at each step, in NumPy.

        Args:
            name: name of the guard, such as "paper" or "none".

        Raises:
            UsageError: U101, there is no such guard, or the task lacks what it needs.
        """
        from stlc.controller.guard.guard import Guard
        from stlc.controller.guard.loop import GuardedLoop

        return GuardedLoop(Guard(self.task, self.policy, name))

    @property
    def network(self) -> PlanProposer:
        """The network of the policy.

        Raises:
            RunError: R101, the run's method trains no network.
        """
        if self.policy.network is None:
            message = f"the policy of `{self.dir.shown}` has no network that proposes plans"
            raise RunError.of("R101", message, help=("export a run of another `--method`, such as `guided`",))
        return self.policy.network

    def plan_judged(self, x0: Tensor) -> tuple[Tensor, PlanVerdicts]:
        """Plans of the policy from states (B, n), and their verdicts."""
        return self.policy.plan_judged(x0)


def _changes(folder: RunDir, overrides: Mapping[str, str] | None, scenario: str | None) -> dict[str, str]:
    trained = folder.record().get("overrides") or {}
    overlay: Mapping[str, str] = {}
    if scenario is not None:
        there = f"what counts is the system that the run stores: add it to {folder.shown}/{RunDir.SYSTEM}"
        overlay = scenario_constants(folder.source(RunDir.SYSTEM), scenario, trained, there)
    return {**trained, **overlay, **(overrides or {})}


Net = TypeVar("Net", bound=nn.Module)


def load_weights(folder: RunDir, module: Net, prefix: str) -> Net:
    """Load the weights of a module from the checkpoint of a run, where their names begin with `prefix.`.

    Raises:
        RunError: R101, there is no checkpoint, it is damaged, or it does not fit the module; R102, it belongs
            to another task.
    """
    saved = load_checkpoint(folder, **folder.hashes | {"system_hash": trained_on(folder)})
    try:
        module.load_state_dict(weights(saved, prefix))
    except RuntimeError as error:
        message = f"the checkpoint of `{folder.shown}` does not fit its network"
        raise RunError.of("R101", message, note=(str(error),)) from error
    return module


def trained_on(folder: RunDir) -> str:
    """Hash of the system file, for comparison with the hash that is stored in a run's checkpoint.

    The file in the run's folder may have been edited since training began. Edits of the worlds, scenarios and
    backup policy do not affect what a policy learns. If there are only such edits, the hash at the start of
    training is returned, so that the checkpoint is accepted. After any other edit the hash of the present
    file is returned, so that the checkpoint is refused.
    """
    now, record = folder.hashes["system_hash"], folder.record()
    then, learnt = record.get("system_hash"), record.get("learnt")
    if now == then or not isinstance(then, str) or learnt is None:
        return now
    decl = load_system_decl(folder.source(RunDir.SYSTEM), record.get("overrides") or {})
    return then if decl.learnt == learnt else now


def save_library(folder: RunDir, library: Mapping[str, str], below: str = RunDir.LIB) -> None:
    """Save a specification's imports (name -> text) in the subfolder `below` of a run's folder."""
    for key, text in library.items():
        folder.write(f"{below}/{file_of(key)}", text)
    if library:
        folder.write_json(f"{below}/{RunDir.INDEX}", {key: file_of(key) for key in library})


def save_config(folder: RunDir, config: ResolvedConfig) -> None:
    """Write the resolved options of a run, as JSON, which is also YAML."""
    folder.write(RunDir.CONFIG, json.dumps(asdict(config), indent=1) + "\n")


def _unknown(folder: RunDir, registry: PackageRegistry[Any], name: str) -> PluginError:
    """Error S206: a run needs a plugin that is not there."""
    noted = folder.record().get("plugins")
    source = noted.get(name) if isinstance(noted, dict) else None
    path = registry.moved.get(name, "FILE.py")
    message = f"run `{folder.shown}` needs the {registry.kind} `{name:.40}`, which stlc does not have"
    note = (f"it came from {source.get('source')}",) if isinstance(source, dict) else ()
    help_ = f"if you trust its file: {variable(registry.group)}={path} stlc …"
    return PluginError.of("S206", message, note=note, help=(help_,))


@dataclass(frozen=True, slots=True)
class StoredConfig:
    """Resolved options of a run that every method has."""

    method: str
    hidden: list[int]


def load_config(folder: RunDir) -> ResolvedConfig:
    """Read the resolved options of a run.

    A method or planner from elsewhere is found only if it is installed, or the user names its file: nothing
    that the run names is imported.

    Raises:
        RunError: R101, their file is missing or damaged.
        PluginError: S206, the run needs a method or planner that is not there, or that cannot be loaded.
    """
    values: dict[str, Any] = folder.read_json(RunDir.CONFIG, StoredConfig)
    for registry, name in ((METHODS, values["method"]), (PLANNERS, values.get("planner"))):
        if isinstance(name, str) and name not in registry:
            raise _unknown(folder, registry, name)
    try:
        kind: type[ResolvedConfig] = METHODS.get(values["method"]).options
        engine = {field.name: values[field.name] for field in fields(kind) if field.name in values}
        return kind(**{**engine, "hidden": tuple(engine["hidden"])}).checked()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RunError(folder.damaged(RunDir.CONFIG, error)) from error
