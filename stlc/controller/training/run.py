"""A finished or unfinished training run: its folder, its task, its policy."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import torch

from stlc.compile.frontend.modules import file_of
from stlc.controller.policies.policy import BestOfKPolicy, network_of
from stlc.controller.problem.task import Task
from stlc.controller.training.checkpoint import load_checkpoint, weights
from stlc.controller.training.config import ResolvedConfig, checked_config
from stlc.diagnostics import Diagnostic, RunError
from stlc.dynamics.model.system import System
from stlc.dynamics.scenarios.scenario import scenario_constants
from stlc.dynamics.schema.schema import load_system_decl
from stlc.files import read_source, write_atomic
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse
from stlc.provenance import sha256
from stlc.rundir import RUNS, RunDir

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

SPEC = "spec.stl"
SYSTEM = "system.yaml"
LIB = "lib"
INDEX = "index.json"
CONFIG = "config.resolved.yaml"


@dataclass(frozen=True, slots=True)
class Run:
    """One run.

    Attributes:
        dir: its folder.
        task: what was trained for.
        policy: the trained policy; call it with states (B, n) for plans (B, T, m) in physical units.
    """

    dir: RunDir
    task: Task
    policy: BestOfKPolicy

    @classmethod
    def open(
        cls,
        where: Path | str = "latest",
        *,
        root: Path = RUNS,
        device: str = "cpu",
        overrides: Mapping[str, str] | None = None,
        scenario: str | None = None,
    ) -> Run:
        """Load a run by folder, name, number, or `latest`, below the folder `root` of all runs.

        `overrides` change constants and give values to parameters, as `--set` does, and a `scenario` of
        the system file is laid over it; the policy stays.

        Raises:
            UsageError: there is no such run.
            RunError: R101, it is damaged or has no checkpoint yet; R102, its checkpoint is of another task.
            SpecError, SystemFileError: its specification or system is invalid.
        """
        folder = RunDir.open(where, root)
        task = load_task(folder, overrides, scenario)
        engine = load_config(folder)
        saved = load_checkpoint(folder, spec_hash=spec_hash(folder), system_hash=_trained_on(folder))
        network = network_of(task, engine)
        try:
            network.load_state_dict(weights(saved, "average"))
        except RuntimeError as error:
            raise RunError(
                Diagnostic(
                    "R101", f"the checkpoint of `{folder.shown}` does not fit its network", note=(str(error),)
                )
            ) from error
        return cls(folder, task, BestOfKPolicy(task, network.to(torch.device(device)).eval()))


def load_task(
    folder: RunDir, overrides: Mapping[str, str] | None = None, scenario: str | None = None
) -> Task:
    """Compile the specification and the system that lie in a run's folder, changed as `overrides` say.

    A parameter that the policy was trained with keeps its column: it has the value that is given.
    """
    trained = folder.record().get("overrides") or {}
    spec = replace(parse(read_source(folder.path / SPEC)), library=read_library(folder))
    overlay = {} if scenario is None else scenario_constants(folder.path / SYSTEM, scenario, trained)
    changed = {**trained, **overlay, **(overrides or {})}
    drawn = {item.name for item in spec.items if isinstance(item, ast.Param)} - trained.keys()
    values = {name: text for name, text in changed.items() if name in drawn}
    constants = {name: text for name, text in changed.items() if name not in drawn}
    system = System.load(folder.path / SYSTEM, changed, scenario=scenario)
    return Task.of(spec, system, overrides=constants, values=values)


def spec_hash(folder: RunDir) -> str:
    """SHA-256 of the specification in a run's folder and of what `--set` changed in it."""
    return _hash(folder, SPEC, read_library(folder))


def system_hash(folder: RunDir) -> str:
    """SHA-256 of the system file in a run's folder and of what `--set` changed in it."""
    return _hash(folder, SYSTEM)


def _trained_on(folder: RunDir) -> str:
    """The hash of the system that a policy was trained on, if it may be deployed on the one in the folder.

    What a policy learns from must be as it was; worlds, scenarios and the backup may be edited since.
    """
    now, record = system_hash(folder), folder.record()
    then, learnt = record.get("system_hash"), record.get("learnt")
    if now == then or not isinstance(then, str) or learnt is None:
        return now
    decl = load_system_decl(folder.path / SYSTEM, record.get("overrides") or {})
    return then if decl.learnt == learnt else now


def _hash(folder: RunDir, name: str, library: Mapping[str, str] | None = None) -> str:
    overrides = folder.record().get("overrides") or {}
    kept = json.dumps(dict(sorted(library.items()))) if library else ""
    return sha256(read_source(folder.path / name).text + json.dumps(overrides, sort_keys=True) + kept)


def save_library(folder: RunDir, library: Mapping[str, str], below: str = LIB) -> None:
    """Keep what a specification imports: the texts in a folder of their own, and which is which."""
    for key, text in library.items():
        write_atomic(folder.path / below / file_of(key), text)
    if library:
        folder.write_json(f"{below}/{INDEX}", {key: file_of(key) for key in library})


def read_library(folder: RunDir, below: str = LIB) -> dict[str, str]:
    """The texts that `save_library` kept, by key. Raises RunError (R101) where one is damaged."""
    if not (folder.path / below / INDEX).is_file():
        return {}
    index = folder.read_json(f"{below}/{INDEX}")
    names = index.values() if isinstance(index, dict) else [None]
    if any(not isinstance(name, str) or name.startswith("/") or ".." in name.split("/") for name in names):
        raise RunError(Diagnostic("R101", f"`{folder.shown}/{below}/{INDEX}` is damaged"))
    return {key: read_source(folder.path / below / name).text for key, name in index.items()}


def save_config(folder: RunDir, engine: ResolvedConfig) -> None:
    """Write what the engine decided; JSON is YAML too."""
    write_atomic(folder.path / CONFIG, json.dumps(asdict(engine), indent=1) + "\n")


def load_config(folder: RunDir) -> ResolvedConfig:
    """Read what the engine decided. Raises RunError R101 when that is damaged."""
    try:
        values: dict[str, Any] = json.loads((folder.path / CONFIG).read_text())
        known = {field.name for field in fields(ResolvedConfig)}
        engine = {key: value for key, value in values.items() if key in known}
        return checked_config(ResolvedConfig(**{**engine, "hidden": tuple(engine["hidden"])}))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise RunError(
            Diagnostic("R101", f"`{folder.shown}/{CONFIG}` is missing or damaged: {error}")
        ) from error
