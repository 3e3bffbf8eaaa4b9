"""Relaxed search: where no plan keeps the margin, the safe one with the largest is followed."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from stlc.controller.guard.candidates import REPAIRED, Limits
from stlc.controller.guard.guard import Guard, GuardDecision
from stlc.controller.guard.kinds.full import GUARD as FULL
from stlc.controller.guard.margins import with_margins
from stlc.controller.guard.search import RelaxedSearch, StagedSearch
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """\
stlc: 1
name: cart
time: {dt: 0.5 s, horizon: 6 steps}
state: {p: {unit: m, range: [-4, 4]}, w: {unit: m/s, range: [-2, 2]}}
control: {u: {unit: m/s^2, range: [-2, 2]}}
flow: {p: w, w: u}
init: {mixture: [{draw: {p: "uniform(-2, 2)", w: "uniform(-2, 2)"}}]}
backup: {bins: 5, T0: [1, 2], batch: 256}
"""
SPEC = """\
signal p, w
@safety
require clear: always[0, T] p <= 2
@safety
require behind: always[0, T] p >= -2
require quick: eventually[0, T] w >= 0.1
"""
LIMITS = Limits(seconds=None, margin={"clear": 0.6, "behind": 0.6})


def cart() -> Task:
    decl = parse_system(Source("cart.yaml", SYSTEM), Path("cart.yaml"))
    return Task.of(Spec.parse(Source("a.stl", SPEC)), System(decl))  # type: ignore[arg-type]


class Onward(Policy):
    """Speeds up."""

    def candidates(self, x0: Tensor) -> Tensor:
        return torch.ones((len(x0), 1, 6, 1), dtype=x0.dtype)


def decided(task: Task, x: Tensor) -> GuardDecision:
    return Guard(task, Onward(task), "full", limits=LIMITS).decide(x)


@pytest.mark.apart
def test_what_is_beside_the_wall_stays_as_far_from_it_as_it_is() -> None:
    task, x = cart(), torch.tensor([[1.9, 0.0], [1.7, -0.2]], dtype=torch.float64)
    found = decided(task, x)
    assert found.safe.all()
    assert found.source.tolist() == [REPAIRED, REPAIRED]
    spare = task.judge(x, found.plan).requirements[:, 0]
    torch.testing.assert_close(spare, 2.0 - x[:, 0], rtol=0, atol=0.01)


def test_whom_the_plain_guard_can_save_is_saved_with_a_margin_too() -> None:
    task = cart()
    x = task.sample(60, seed=1, dtype=torch.float64)
    plain = StagedSearch(task, Onward(task), FULL, limits=Limits(seconds=None)).search(
        x, Onward(task).plan(x)
    )
    found = decided(task, x)
    strict = with_margins(task, LIMITS.margin)
    assert 10 < int(plain.is_safe.sum()) < 60
    assert bool((found.safe | ~plain.is_safe).all())
    enough = strict.judge(x, found.plan).safe >= -1e-6
    assert 10 < int(enough.sum()) < int(found.safe.sum())
    lost = ~found.safe
    assert (found.source[lost] == 2).all()  # the longest safe prefix


def test_it_spares_more_than_a_guard_that_asks_for_nothing() -> None:
    task = cart()
    x = task.sample(60, seed=2, dtype=torch.float64)
    strict = with_margins(task, LIMITS.margin)
    guard = RelaxedSearch(task, strict, Onward(task), FULL, limits=LIMITS)
    found = guard.search(x, Onward(task).plan(x))
    plain = StagedSearch(task, Onward(task), FULL, limits=Limits(seconds=None)).search(
        x, Onward(task).plan(x)
    )
    short = plain.is_safe & ~found.is_safe
    assert int(short.sum()) > 5
    spare, other = (task.judge(x, each.plans).safe[short] for each in (found, plain))
    assert (spare >= -1e-6).all()
    assert float(spare.mean()) > float(other.mean())
    torch.testing.assert_close(found.rho, strict.judge(x, found.plans).rho)
