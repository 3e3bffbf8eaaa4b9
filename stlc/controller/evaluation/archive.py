"""Files of a deployment in its run folder: `trace.npz`, `scene.npz` and `eval/simulate.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from stlc.compile.frontend.modules import spec_sha256
from stlc.controller.evaluation.executed import model_consistent
from stlc.controller.training.run import read_library
from stlc.files import atomic_path
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse
from stlc.rundir import SPEC, SYSTEM, TRACE, UNGUARDED
from stlc.source import Source
from stlc.trace import Trace, TraceMeta, save_trace
from stlc.version import __version__

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.controller.deployment.simulator import DeploymentRecording, Setting
    from stlc.controller.evaluation.rules import Rules
    from stlc.controller.training.run import Run
    from stlc.dynamics.model.system import System


def trace_of(run: Run, recording: DeploymentRecording, setting: Setting, rules: Rules | None = None) -> Trace:
    """Content of the trace file of a deployment: one trace per agent and seed.

    `rules`: specification of closed-loop runs; it is stored in the trace.

    Besides the states, a trace contains these arrays of shape (traces, steps):

    - `action.NAME`: the actuator command of control NAME.
    - `decision`: the source of the followed plan. 0: policy. 1: backup policy. 2: plan that stays safe
      longest. 3: plan found by another search.
    - `t0`: the number of first actions that the backup policy chose; 0 for other plans.
    - `plan_rho`: the robustness of the followed plan.
    - `policy_rho`: the robustness of the policy's plan.
    - `foreseen`: 1 if the true next state equals the model's prediction, else 0.

    The arrays `seed` and `agent` have the shape (traces,).
    """
    system = run.task.system
    states = np.moveaxis(recording.states, -1, 0)
    actions = zip(system.control_names, np.moveaxis(_commanded(system, recording), -1, 0), strict=True)
    rows = np.arange(len(recording.states))
    return Trace(
        signature=system.signature,
        dt=run.task.system.dt,
        data=dict(zip(run.task.system.names, states, strict=True)),
        extras={
            **{f"action.{name}": action for name, action in actions},
            "decision": recording.source,
            "t0": recording.t0,
            "plan_rho": recording.rho,
            "policy_rho": recording.policy_rho,
            "foreseen": model_consistent(run.task, recording).astype(np.int8),
            "seed": np.array(setting.seeds)[rows // recording.agents],
            "agent": rows % recording.agents,
        },
        meta=_meta(run, setting, rules),
    )


def _commanded(system: System, recording: DeploymentRecording) -> NDArray[np.float64]:
    """Actuator commands of the recorded actions, with the feedback around plans, (rows, steps, m)."""
    states = torch.from_numpy(recording.states[:, :-1]).flatten(0, 1)
    planned = torch.from_numpy(recording.actions)
    return system.commanded(states, planned.flatten(0, 1)).reshape(planned.shape).numpy()


def save_trace_of(
    run: Run,
    recording: DeploymentRecording,
    setting: Setting,
    also: Path | None = None,
    *,
    rules: Rules | None = None,
) -> list[Path]:
    """Write the trace of a deployment into the run folder, and also to the path `also`; return all paths.

    `rules`: specification of closed-loop runs; it is stored in the trace and used when the trace is checked
    later.

    Raises:
        MissingError: R201, a file cannot be written.
    """
    trace = trace_of(run, recording, setting, rules)
    paths = [run.dir.place(TRACE), *([also] if also is not None else [])]
    for path in paths:
        save_trace(path, trace)
    return paths


def save_unguarded(
    run: Run, recording: DeploymentRecording | None, setting: Setting, rules: Rules | None = None
) -> None:
    """Write the results of a deployment without guard into the run folder.

    The results are the trace, and the snapshots (arrays for pictures) of the first seed. If `recording` is
    None, the files that an earlier deployment wrote are deleted instead. `rules`: specification of
    closed-loop runs; it is stored in the trace.

    Raises:
        MissingError: R201, a file cannot be written.
    """
    trace_path, scene_path = map(run.dir.place, UNGUARDED)
    if recording is None:
        for path in (trace_path, scene_path):
            path.unlink(missing_ok=True)
        return
    trace = trace_of(run, recording, setting, rules)
    first = slice(0, recording.agents)
    data = {name: rows[first] for name, rows in trace.data.items()}
    extras = {name: rows[first] for name, rows in trace.extras.items()}
    save_trace(trace_path, replace(trace, data=data, extras=extras))
    save_scene(scene_path, recording.scene)


def _meta(run: Run, setting: Setting, rules: Rules | None) -> TraceMeta:
    record, spec = run.dir.record(), run.dir.source(SPEC).text
    library = read_library(run.dir)
    return TraceMeta(
        spec_name=run.task.compiled.name,
        spec_path=str(record.get("spec_path", "")),
        spec_text=spec,
        spec_library=library,
        spec_set=_set_in(spec, run),
        spec_hash=spec_sha256(spec, library),
        judge_path="" if rules is None else rules.path,
        judge_text="" if rules is None else rules.spec.source.text,
        judge_library={} if rules is None else dict(rules.spec.library or {}),
        judge_set={} if rules is None else dict(rules.overrides),
        system_name=run.task.system.decl.name,
        system_path=str(record.get("system_path", "")),
        system_text=run.dir.source(SYSTEM).text,
        system_hash=run.task.system.decl.hash,
        run=run.dir.name,
        seed=setting.seeds[0],
        horizon=run.task.window,
        dt=run.task.system.dt,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        stlc_version=__version__,
    )


def _set_in(spec: str, run: Run) -> dict[str, str]:
    """Values that replaced those in the specification text, in training or deployment: constant -> text."""
    own = {item.name for item in parse(Source(SPEC, spec)).items if isinstance(item, (ast.Const, ast.Param))}
    changed = run.task.system.decl.overrides.items()
    return {name: text for name, text in changed if name in own and name not in run.task.system.names}


def save_scene(path: Path, scene: Mapping[str, NDArray[Any]]) -> None:
    """Write the snapshots `scene` (arrays for pictures, stacked over time) to the `.npz` file `path`.

    Raises:
        MissingError: R201, the file cannot be written.
        ValueError: an array contains Python objects.
    """
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **scene)
