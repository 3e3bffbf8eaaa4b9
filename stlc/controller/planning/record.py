"""Storage of plans as traces: predicted states and actions, and the specification."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np
import torch

from stlc.compile.frontend.modules import library_of, spec_sha256
from stlc.grammar import ast
from stlc.trace import Trace, TraceMeta
from stlc.version import __version__

if TYPE_CHECKING:
    from stlc.controller.planning.planner import PlanResult
    from stlc.controller.problem.task import Task


@torch.no_grad()
def trace_of(task: Task, result: PlanResult, seed: int | None = None) -> Trace:
    """Trace file's content for plans: the predicted trajectory from each initial state is one trace.

    Further arrays: `action.NAME`, the actuator commands of every control, (traces, steps); `plan_rho`, the
    robustness of the plan, (traces,); `infeasible`, 1 if the planner proved that no plan satisfies the
    specification, (traces,).
    """
    states = task.rollout(result.states, result.plans).numpy()
    commanded = task.system.commanded(
        torch.as_tensor(states[:, :-1]).flatten(0, 1), result.plans.flatten(0, 1)
    ).reshape(result.plans.shape)
    actions = zip(task.system.control_names, np.moveaxis(commanded.numpy(), -1, 0), strict=True)
    return Trace(
        signature=task.system.signature,
        dt=task.system.dt,
        data=dict(zip(task.system.names, np.moveaxis(states, -1, 0), strict=True)),
        extras={
            **{f"action.{name}": action for name, action in actions},
            "plan_rho": result.rho.numpy(),
            "infeasible": result.infeasible.numpy().astype(np.int8),
        },
        meta=_meta(task, seed),
    )


def _meta(task: Task, seed: int | None) -> TraceMeta:
    spec, decl = task.compiled.spec, task.system.decl
    library = library_of(spec)
    own = {each.name for each in spec.items if isinstance(each, (ast.Const, ast.Param))}
    return TraceMeta(
        spec_name=task.compiled.name,
        spec_path=spec.source.name,
        spec_text=spec.source.text,
        spec_library=library,
        spec_set={name: text for name, text in decl.overrides.items() if name in own},
        spec_hash=spec_sha256(spec.source.text, library),
        system_name=decl.name,
        system_path=str(decl.path),
        system_text=decl.source.text,
        system_hash=decl.hash,
        seed=seed,
        horizon=task.system.horizon,
        dt=task.system.dt,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        stlc_version=__version__,
    )
