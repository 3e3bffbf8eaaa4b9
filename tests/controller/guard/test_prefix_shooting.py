"""The backup policy against a slow enumeration, and the exactness of safe prefixes."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.guard.candidates import Limits, finite, first, grid_of
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.safe_prefix import copied, prefix_robustness
from stlc.controller.guard.search import StagedSearch
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.monitor.verdict import Monitor
from stlc.runtime.decision import best
from stlc.runtime.prefixes import PrefixGrid

F64 = torch.float64


class Constant(Policy):
    """A policy that always plans the same action."""

    def __init__(self, task: Task, action: float) -> None:
        super().__init__(task)
        self.action = action
        self.rows: list[int] = []

    def candidates(self, x0: Tensor) -> Tensor:
        self.rows.append(len(x0))
        return torch.full((len(x0), 1, self.task.horizon, 1), self.action, dtype=x0.dtype)


def paper_search(task: Task, policy: Policy, grid: PrefixGrid, seconds: float | None = None) -> StagedSearch:
    """The stages of the paper's guard."""
    return StagedSearch(task, policy, PAPER, grid=grid, limits=Limits(paper=seconds))


def grid(**changed: object) -> PrefixGrid:
    values = {"values": ((-10.0, -5.0, 0.0, 5.0, 10.0),), "lengths": (1, 2), "batch": 4096} | changed
    return PrefixGrid(**values)  # type: ignore[arg-type]


def failing(task: Task, action: float, n: int = 400, seed: int = 0) -> tuple[Tensor, Tensor]:
    """States in which a constant plan violates the specification, and that plan."""
    x = task.sample(n, seed=seed, dtype=F64)
    plan = torch.full((n, task.horizon, 1), action, dtype=F64)
    bad = task.judge(x, plan).rho < -1e-6
    return x[bad], plan[bad]


def slow_choice(task: Task, x: Tensor, action: float, g: PrefixGrid) -> tuple[int, float, bool]:
    """Choice for one state, plan by plan: (T0, rho, whether phi or phi_safe was met)."""
    for length in g.lengths:
        heads = [(action,) * length, *product(g.values[0], repeat=length)]
        plans = torch.tensor([[*head, *[action] * (task.horizon - length)] for head in heads], dtype=F64)
        judged = task.judge(x.expand(len(heads), -1), plans[..., None])
        good = [float(r) for r in judged.rho if r >= -1e-6]
        safe = [float(r) for r, s in zip(judged.rho, judged.safe, strict=True) if s >= -1e-6]
        if good or safe:
            return length, max(good or safe), True
    return g.lengths[-1], float("nan"), False


@pytest.mark.parametrize("action", [10.0, 0.0, -10.0])
def test_the_search_is_that_of_the_paper(car_task: Task, action: float) -> None:
    x, plan = failing(car_task, action)
    g = grid()
    found = paper_search(car_task, Constant(car_task, action), g).search(x, plan)
    met = 0
    for i in range(min(len(x), 120)):
        t0, rho, done = slow_choice(car_task, x[i], action, g)
        assert int(found.prefix_length[i]) == t0
        assert int(found.source[i]) == (1 if done else 2)
        if done:
            met += 1
            assert float(found.rho[i]) == pytest.approx(rho, abs=1e-6)
    assert met > 20


def test_what_is_found_is_what_it_says(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0)
    found = paper_search(car_task, Constant(car_task, 10.0), grid()).search(x, plan)
    judged = car_task.judge(x, found.plans)
    assert torch.equal(judged.rho, found.rho)
    assert torch.equal(judged.safe >= -1e-6, found.is_safe)
    assert (found.is_safe | (found.rho >= -1e-6) | (found.source == 2)).all()
    assert ((found.source == 1) == (found.is_safe | (found.rho >= -1e-6))).all()


def test_batches_do_not_change_the_choice_and_bound_the_memory(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, n=20)
    whole = paper_search(car_task, Constant(car_task, 10.0), grid()).search(x, plan)
    policy = Constant(car_task, 10.0)
    pieces = paper_search(car_task, policy, grid(batch=20)).search(x, plan)
    assert max(policy.rows) <= 20
    for name in ("plans", "source", "prefix_length", "rho", "safe"):
        assert torch.equal(getattr(whole, name), getattr(pieces, name))


@pytest.mark.slow
def test_a_decision_without_time_takes_the_best_of_what_it_has(car_task: Task) -> None:
    """The clock is looked at after each batch; one of them is always judged."""
    x, plan = failing(car_task, 10.0, n=60)
    whole = paper_search(car_task, Constant(car_task, 10.0), grid(batch=3)).search(x, plan)
    backup = StagedSearch(
        car_task, Constant(car_task, 10.0), PAPER, grid=grid(batch=3), limits=Limits(paper=0.0)
    )
    hurried = backup.search(x, plan)
    assert len(hurried.plans) == len(x)
    judged = car_task.judge(x, hurried.plans)
    assert torch.equal(judged.rho, hurried.rho)
    assert bool((whole.is_safe.long() >= hurried.is_safe.long()).all())
    assert bool((whole.is_safe & ~hurried.is_safe).any())
    assert bool((hurried.prefix_length == 1).all())
    calm = StagedSearch(
        car_task, Constant(car_task, 10.0), PAPER, grid=grid(batch=3), limits=Limits(paper=1e9)
    ).search(x, plan)
    assert torch.equal(calm.plans, whole.plans)


QUEUE = {"x": -6.0, "v": 0.0, "sign": 0.0, "tau": 0.0, "dx": 4.0, "v_lead": 0.0, "yielding": 1.0}
"""Behind a car that stands at a stop sign: no plan meets the deadline, so robustness is flat."""


def at(task: Task, state: Mapping[str, float]) -> torch.Tensor:
    return torch.tensor([[state[name] for name in task.system.names]], dtype=F64)


def test_flat_robustness_does_not_make_a_car_brake_for_ever(car_task: Task) -> None:
    """In a queue before a stop sign the deadline cannot be met; the car moves up all the same."""
    x = at(car_task, QUEUE)
    plan = torch.full((1, car_task.horizon, 1), -10.0, dtype=F64)
    found = paper_search(car_task, Constant(car_task, -10.0), grid()).search(x, plan)
    assert bool(found.is_safe[0])
    assert float(found.rho[0]) < 0
    assert float(found.plans[0, 0, 0]) > 0


def test_a_safe_plan_that_was_begun_is_not_lost(car_task: Task) -> None:
    """Fast behind a car at rest: only braking at once and for long is safe, longer than prefixes are."""
    state = {"x": -6.0, "v": 7.0, "sign": 0.0, "tau": 0.0, "dx": 3.9, "v_lead": 0.0, "yielding": 1.0}
    x = at(car_task, state)
    fast = torch.full((1, car_task.horizon, 1), 10.0, dtype=F64)
    brake = torch.full((1, car_task.horizon, 1), -10.0, dtype=F64)
    backup = paper_search(car_task, Constant(car_task, 10.0), grid())
    assert not bool(backup.search(x, fast).is_safe[0])
    found = backup.search(x, fast, brake)
    assert bool(found.is_safe[0])
    assert torch.equal(found.plans, brake)


def test_an_unavoidable_collision_is_met_braking(car_task: Task) -> None:
    state = {"x": -8.0, "v": 8.0, "sign": 1.0, "tau": 5.0, "dx": 2.0, "v_lead": 0.0, "yielding": 0.0}
    x = torch.tensor([[state[name] for name in car_task.system.names]], dtype=F64)
    plan = torch.full((1, car_task.horizon, 1), 10.0, dtype=F64)
    found = paper_search(car_task, Constant(car_task, 10.0), grid(lengths=(1, 2, 3))).search(x, plan)
    assert int(found.source[0]) == 2
    assert float(found.plans[0, 0, 0]) == -10.0


def test_a_plan_that_is_no_number_is_replaced(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0)
    policy = Constant(car_task, float("nan"))
    found = paper_search(car_task, policy, grid()).search(x, torch.full_like(plan, torch.nan))
    assert torch.isfinite(found.plans).all()
    assert not torch.isnan(found.rho).any()
    assert finite(
        torch.tensor([torch.nan, torch.inf, 3.0], dtype=F64)[:, None], car_task
    ).flatten().tolist() == [
        0.0,
        0.0,
        3.0,
    ]


def test_the_grid_is_that_of_the_system_file(car_task: Task) -> None:
    g = grid_of(car_task)
    assert g.values == ((-10.0, -5.0, 0.0, 5.0, 10.0),)
    assert g.lengths == car_task.system.decl.backup.lengths
    assert g.prefixes(2).tolist() == [[[a], [b]] for a, b in product(g.values[0], repeat=2)]


def test_the_grid_of_two_controls() -> None:
    g = PrefixGrid(((0.0, 1.0), (5.0, 6.0, 7.0)), (2,), 10)
    prefixes = {tuple(map(tuple, prefix)) for prefix in g.prefixes(2).tolist()}
    assert len(prefixes) == 6**2


# ---------------------------------------------------------------------------- ties


def test_keys_decide_in_order_and_then_the_first_choice() -> None:
    allowed = torch.tensor([[True, True, True, False], [True, True, True, True]])
    rho = torch.tensor([[1.0, 2.0, 2.0, 9.0], [3.0, 3.0, 3.0, 3.0]])
    cost = torch.tensor([[0.0, 5.0, 4.0, 0.0], [1.0, 1.0, 1.0, torch.nan]])
    assert first(best(allowed.t(), (rho.t(), -cost.t()), TORCH)).tolist() == [2, 0]


# ------------------------------------------------------------------------ prefixes


@given(st.integers(0, 10_000))
def test_prefix_robustness_is_the_bound_over_continuations(car_task: Task, seed: int) -> None:
    """A prefix is unsafe exactly where the most harmless continuation does not help."""
    generator = torch.Generator().manual_seed(seed)
    formulas = [rule.formula for rule in car_task.compiled.safety]
    x = car_task.sample(8, generator=generator, dtype=F64)
    u = torch.rand(8, car_task.horizon, 1, generator=generator, dtype=F64) * 20 - 10
    columns = car_task.system.rollout_columns(x, u)
    falls = prefix_robustness(formulas, columns)
    assert falls.shape == (car_task.horizon + 1, 8)
    assert (falls[1:] <= falls[:-1]).all()
    whole = car_task.judge(x, u).safe >= -1e-6
    assert torch.equal(falls[-1] >= -1e-6, whole)
    for k in (0, 5, 20):
        harmless = {"dx": 10.0, "x": -5.0, "tau": 8.0}
        cut = {
            name: torch.cat((column[: k + 1], torch.full_like(column[k + 1 :], harmless[name])))
            if name in harmless
            else column
            for name, column in columns.items()
        }
        rho = car_task.graph.per_requirement_columns(cut, ops=_torch())
        names = [rule.name for rule in car_task.rules]
        safe = rho[:, [names.index(rule.name) for rule in car_task.compiled.safety]].amin(1)
        assert torch.equal(falls[k] >= -1e-6, safe >= -1e-6)


def _torch() -> object:

    return TORCH


@pytest.mark.parametrize(
    "formula",
    [
        "always[0, 0.5 s] x > 0",
        "always[0.2 s, 0.3 s] (x > 0 or y < 0) and x < 3",
        "always x > -1",
        "y > 0 -> always[0.1 s, 0.4 s] x > 0",
        "always[0, 0.4 s] (x > 0 and next(y) < 0)",
        "always[0, 0.3 s] eventually[0, 0.2 s] x > 0",
    ],
)
def test_running_minima_are_the_bounds_of_all_prefixes(formula: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rule = Monitor(f"signal x, y\nrequire r: {formula}", dt=0.1).compiled.requirements[0]
    generator = torch.Generator().manual_seed(0)
    columns = {name: torch.randn(7, 40, generator=generator, dtype=F64) for name in "xy"}
    columns["x"][4, ::9] = torch.nan
    found = prefix_robustness([rule.formula], columns)
    assert copied(rule.formula) == ("eventually" in formula)
    monkeypatch.setattr("stlc.controller.guard.safe_prefix.copied", lambda _: True)
    torch.testing.assert_close(
        found, prefix_robustness([rule.formula], columns), rtol=0, atol=0, equal_nan=True
    )


def test_a_predicate_on_the_initial_state_is_evaluated_on_no_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    rule = Monitor("signal x, y\nrequire r: y > 0 -> always x > 0", dt=0.1).compiled.requirements[0]
    widths = []

    def watched(formulas: object, columns: Mapping[str, torch.Tensor], **named: object) -> object:
        widths.append(columns["x"].shape[1])
        return evaluate(formulas, columns, **named)  # type: ignore[arg-type]

    monkeypatch.setattr("stlc.controller.guard.safe_prefix.evaluate", watched)
    prefix_robustness([rule.formula], {name: torch.ones(7, 4, dtype=F64) for name in "xy"})
    assert not copied(rule.formula)
    assert set(widths) == {4}


def test_without_safety_requirements_every_prefix_is_safe() -> None:
    column = torch.zeros(4, 3, dtype=F64)
    assert torch.isposinf(prefix_robustness([], {"x": column})).all()
