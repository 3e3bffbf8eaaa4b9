"""Creation of a run's folder: copies of its inputs, and a record of options, versions and machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from stlc.compile.dump import dump
from stlc.controller.evaluation.rules import keep_rules
from stlc.controller.problem.task import Task
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.run.run import save_config, save_library
from stlc.controller.search.planner import prepared
from stlc.controller.search.planner_policy import PlannerChoice, planner_of
from stlc.controller.training.config import ENGINE_VERSION, TrainConfig, resolve_config
from stlc.provenance import git_state, hardware, sha256, versions
from stlc.registry import METHODS, PLANNERS
from stlc.rundir import RunDir
from stlc.version import __version__


@dataclass(frozen=True, slots=True)
class Launch:
    """Place and name of a new run.

    Attributes:
        root: folder of all runs.
        name: name of the run; random if None. One that cannot name a folder is refused (U101).
        overrides: constants and keys of the system file that `--set` changed, name -> text.
        command: command line, which the run's record keeps.
    """

    root: Path = RunDir.RUNS
    name: str | None = None
    overrides: Mapping[str, str] = field(default_factory=dict)
    command: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.name is not None:
            RunDir.require_name(self.name)


def open_folder(task: Task, config: TrainConfig, launch: Launch | None = None) -> RunDir:
    """Create the folder of a new run with everything needed to reproduce it.

    Args:
        task: problem to train for.
        config: the user's options.
        launch: place and name of the run.

    Raises:
        MissingError: R201, the folder cannot be written.
        UsageError: U101, an option is refused.
    """
    decl, launch = task.plain.decl, launch or Launch()
    resolved = resolve_config(task, config)  # before the folder: a refused option leaves no run behind
    folder = RunDir.create(launch.root, task.compiled.name, launch.name)
    folder.update(
        {
            "stlc": __version__,
            "command": list(launch.command),
            "status": "running",
            "started": RunDir.now(),
            "spec": task.compiled.name,
            "spec_path": task.compiled.spec.source.name,
            "system": task.system.decl.name,
            "system_path": str(decl.path),
            "overrides": dict(launch.overrides),
            "seed": resolved.seed,
            "budget": config.budget,
            "device": config.device,
            "threads": resolved.threads,
            "options": asdict(replace(config, steps=None)) | {"steps": config.steps and str(config.steps)},
            "engine_version": ENGINE_VERSION,
            "plugins": _plugins(resolved),
            "versions": versions(),
            "git": git_state(),
            "hardware": hardware(),
        }
    )
    folder.write(RunDir.SPEC, task.compiled.spec.source.text)
    save_library(folder, task.compiled.spec.imported_texts())
    folder.write(RunDir.SYSTEM, decl.source.text)
    for path in {world.path for world in decl.worlds if world.path.is_file()}:
        folder.write(path.name, path.read_bytes())
    for name, path in decl.files.items():
        folder.write(name, path.read_bytes())
    keep_rules(folder, task)
    folder.write("compiled.txt", dump(task.compiled))
    hashes = {**folder.hashes, "learnt": decl.learnt}
    folder.update(hashes)
    return folder


def _plugins(config: ResolvedConfig) -> dict[str, dict[str, str]]:
    """Sources of the method and planner that are not of stlc, by name; with the hash of a file."""
    chosen = METHODS.plugin(config.method), PLANNERS.plugin(getattr(config, "planner", ""))
    return {
        each.name: {"source": each.source}
        | ({} if isinstance(each.place, str) else {"sha256": sha256(each.place.read_bytes())})
        for each in chosen
        if each is not None
    }


def open_planner(task: Task, choice: PlannerChoice, *, seed: int, launch: Launch) -> RunDir:
    """Create the folder of a run whose policy is a planner, without training.

    Raises:
        MissingError: R201, the folder cannot be written.
        UsageError: U101, there is no such planner or option, or the planner cannot plan for the task.
    """
    config = TrainConfig(method="plan", planner=choice, seed=seed)
    prepared(planner_of(choice.name, choice.options), task)  # a refusal leaves no run behind
    folder = open_folder(task, config, launch)
    save_config(folder, resolve_config(task, config))
    folder.finish("finished", None)
    return folder
