"""Files of a deployment in its run folder: `trace.npz`, `scene.npz` and `eval/simulate.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from stlc.controller.evaluation.executed import model_consistent
from stlc.controller.search.plan_traces import meta_of, trace_along
from stlc.files import File
from stlc.rundir import RunDir
from stlc.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.controller.deployment.batched import Setting
    from stlc.controller.deployment.simulator import DeploymentRecording
    from stlc.controller.evaluation.rules import Rules
    from stlc.controller.run.run import Run


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
    rows = np.arange(len(recording.states))
    extras: dict[str, NDArray[Any]] = {
        "decision": recording.source,
        "t0": recording.t0,
        "plan_rho": recording.rho,
        "policy_rho": recording.policy_rho,
        "foreseen": model_consistent(run.task, recording).astype(np.int8),
        "seed": np.array(setting.seeds)[rows // recording.agents],
        "agent": rows % recording.agents,
    }
    states, actions = torch.from_numpy(recording.states), torch.from_numpy(recording.actions)
    record = run.dir.record()
    spec_path, system_path = (str(record.get(key, "")) for key in ("spec_path", "system_path"))
    meta = meta_of(run.task, setting.seeds[0])
    meta = replace(meta, run=run.dir.name, spec_path=spec_path, system_path=system_path)
    if rules is not None:
        spec, changed = rules.spec, dict(rules.overrides)
        meta = replace(meta, judge_path=rules.path, judge_text=spec.source.text, judge_set=changed)
        meta = replace(meta, judge_library=dict(spec.library or {}))
    return trace_along(run.task, states, actions, extras, meta)


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
    paths = [run.dir.place(RunDir.TRACE), *([also] if also is not None else [])]
    for path in paths:
        trace.save(path)
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
    trace_path, scene_path = map(run.dir.place, RunDir.UNGUARDED)
    if recording is None:
        for path in (trace_path, scene_path):
            path.unlink(missing_ok=True)
        return
    trace = trace_of(run, recording, setting, rules)
    first = slice(0, recording.agents)
    data = {name: rows[first] for name, rows in trace.data.items()}
    extras = {name: rows[first] for name, rows in trace.extras.items()}
    replace(trace, data=data, extras=extras).save(trace_path)
    save_scene(scene_path, recording.scene)


def save_scene(path: Path, scene: Mapping[str, NDArray[Any]]) -> None:
    """Write the snapshots `scene` (arrays for pictures, stacked over time) to the `.npz` file `path`.

    Raises:
        MissingError: R201, the file cannot be written.
        ValueError: an array contains Python objects.
    """
    with File(path).replaced() as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **scene)
