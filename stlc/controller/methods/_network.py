"""Base of the methods that train a plan network by gradient steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import torch

from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.training.checkpoint import load_checkpoint, weights
from stlc.controller.training.learner import Trainer
from stlc.controller.training.run import spec_hash, trained_on
from stlc.diagnostics import Diagnostic, RunError

if TYPE_CHECKING:
    from stlc.controller.parallel.ddp import Ranks
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import ResolvedConfig
    from stlc.controller.training.objective import Objective
    from stlc.rundir import RunDir


class NetworkMethod(ABC):
    """Training and loading of a network that proposes `config.plans` plans.

    Attributes:
        searches: whether failing states are repaired by local search beside the steps.
        mirrored: whether the network uses the mirror of the system.
    """

    searches = False
    mirrored = False

    @abstractmethod
    def objective(self, learner: Trainer) -> Objective:
        """The loss of plans, at the margin of a training."""

    def learner(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks
    ) -> Trainer:
        """A training before its first step."""
        return Trainer(task, config, steps=steps, device=device, ranks=ranks)

    def network(self, task: Task, config: ResolvedConfig) -> PlanNetwork:
        """The network of a run, its weights drawn from torch's own generator."""
        return PlanNetwork(task, hidden=config.hidden, plans=config.plans, mirrored=self.mirrored)

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str = "cpu") -> BestOfKPolicy:
        """The policy of a run: the averaged weights. Raises RunError: R101 or R102, see `Method.load`."""
        saved = load_checkpoint(run, spec_hash=spec_hash(run), system_hash=trained_on(run))
        network = self.network(task, config)
        try:
            network.load_state_dict(weights(saved, "average"))
        except RuntimeError as error:
            message = f"the checkpoint of `{run.shown}` does not fit its network"
            raise RunError(Diagnostic("R101", message, note=(str(error),))) from error
        return BestOfKPolicy(task, network.to(torch.device(device)).eval())
