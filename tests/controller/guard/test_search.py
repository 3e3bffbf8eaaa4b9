"""Search of a guard: every plan that it returns has a verdict."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.search import StagedSearch
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """\
stlc: 1
name: a
time: {dt: 0.1 s, horizon: 1 steps}
state: {x: {range: [-5, 5]}}
control: {a: {range: [-1, 1]}}
flow: {x: a}
init: {mixture: [{draw: {x: "uniform(-1, 1)"}}]}
"""


class Still(Policy):
    def candidates(self, x0: Tensor) -> Tensor:
        return x0.new_zeros(len(x0), 1, self.task.horizon, 1)


def test_plans_are_judged_although_there_is_no_prefix(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(SYSTEM)
    spec = Spec.parse(Source("a.stl", "spec a\nstate signal x\n@safety\nrequire r: always[0,T] x < 0.4\n"))
    task = Task.of(spec, System.load(tmp_path / "a.yaml"))
    x = task.sample(20, seed=3, dtype=torch.float64)
    plan = torch.zeros(20, 1, 1, dtype=torch.float64)
    found = StagedSearch(task, Still(task), PAPER).search(x, plan)
    judged = task.judge(x, found.plans)
    assert torch.equal(found.safe, judged.safe)
    assert torch.equal(found.rho, judged.rho)
    assert found.is_safe.any()
