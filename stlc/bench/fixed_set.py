"""How a policy does on the states that it was trained on, where these are a fixed set."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stlc.controller.problem.task import satisfied
from stlc.controller.training.checkpoint import load_checkpoint
from stlc.controller.training.run import Run, spec_hash, system_hash

if TYPE_CHECKING:
    from stlc.rundir import RunDir


def training_accuracy(folder: RunDir) -> float | None:
    """Share of its training states that a run's policy satisfies the specification on.

    None where training drew fresh states in every step.
    """
    saved = load_checkpoint(folder, spec_hash=spec_hash(folder), system_hash=system_hash(folder))
    states = saved.tensors.get("training.states")
    if states is None:
        return None
    _, judged = Run.open(folder.path).plan_judged(states.double())
    return float(satisfied(judged.rho).double().mean())
