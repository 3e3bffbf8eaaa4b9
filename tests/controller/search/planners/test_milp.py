"""The mixed-integer encoding against many plans: no proof is contradicted, every solution is a plan."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, PlanSearch, plan
from stlc.controller.search.planners import milp
from stlc.diagnostics import UsageError
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

pytest.importorskip("highspy")

SYSTEM = """
stlc: 1
name: cart
time: {dt: 1 s, horizon: 5 steps, integrator: euler, substeps: 1}
state:
  p: {range: [-4, 4]}
  v: {range: [-2, 2], clamp: true}
  n: {range: [0, 9]}
control:
  a: {range: [-1, 1]}
flow:
  p: v
  v: a
  n: ind(p > 1)
jump:
  - {name: bounce, guard: p > 3, reset: {v: -v}}
  - {name: rest, guard: p < -3, reset: {n: 0}}
init:
  mixture:
    - {name: any, draw: {p: "uniform(-3, 3)", v: "uniform(-2, 2)", n: 0}}
"""

_numbers = st.integers(-12, 12).map(lambda n: n / 4)
_linear = st.sampled_from(
    ["p", "v", "p + v", "p - 0.5 * v", "abs(p)", "max(p, v)", "min(p, -v)", "n - 2", "clip(p, -1, 1)"]
)
_atoms = (
    st.builds("{} > {}".format, _linear, _numbers)
    | st.builds("{} <= {}".format, _linear, _numbers)
    | st.builds("abs(p - {}) < {}".format, _numbers, st.sampled_from([0.25, 0.5, 1]))
    | st.builds("(p - {0}) * (p - {0} - 1) > 0".format, _numbers)
    | st.builds("p^2 + 4 * v^2 < {}".format, st.sampled_from([1, 4]))
    | st.builds("norm(p, v) > {}".format, st.sampled_from([0.5, 2]))
)


def _grown(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    window = st.sampled_from(["[0 s, 5 s]", "[1 s, 3 s]", "[2 s, 2 s]"])
    short = _atoms | st.builds("({} and {})".format, _atoms, _atoms)
    return (
        st.builds("({} {} {})".format, inner, st.sampled_from(["and", "or", "->"]), inner)
        | st.builds("{}{} {}".format, st.sampled_from(["always", "eventually"]), window, short)
        | st.builds("({} until{} {})".format, short, window, short)
        | st.builds("not {}".format, inner)
        | st.builds("always[0 s, 3 s] (eventually[0 s, 2 s] {})".format, short)
        | st.builds("eventually[0 s, 5 s] (once[0 s, 1 s] {})".format, short)
        | st.builds("eventually[1 s, 5 s] ({} since[0 s, 2 s] {})".format, short, short)
    )


formulas = st.recursive(_atoms, _grown, max_leaves=4)


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> System:
    path: Path = tmp_path_factory.mktemp("cart") / "cart.yaml"
    path.write_text(SYSTEM)
    return System.load(path)


def task_of(system: System, text: str) -> Task:
    return Task.of(Spec.parse(Source("cart.stl", f"signal p, v, n\nrequire r: {text}")), system)


def tried(task: Task, x0: torch.Tensor) -> torch.Tensor:
    """Robustness of the best of many plans, (B,): each control at an end or the middle, or random."""
    task.__dict__["native"] = None  # no C is built for every formula
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0]).double()] * 5)
    drawn = 2.0 * torch.rand(1_000, 5, generator=torch.Generator().manual_seed(0)).double() - 1.0
    plans = torch.cat((corners, drawn))[..., None]
    each = [task.judge(state.expand(len(plans), -1), plans, states=False).rho.max() for state in x0]
    return torch.stack(each)


@given(text=formulas)
def test_proofs_and_plans_agree_with_trial(cart: System, text: str) -> None:
    task = task_of(cart, text)
    x0 = task.sample(3, seed=0, dtype=torch.float64)
    best = tried(task, x0)
    encoded = plan(task, x0, "milp", budget=PlanBudget(5.0))
    assert not bool(((best >= 0.0) & encoded.infeasible).any()), text
    clear = (best > 0.01) & ("norm" not in text and "^2" not in text)
    assert bool((encoded.satisfied | ~clear).all()), text


PIECEWISE = """
stlc: 1
name: piecewise
time: {{dt: 1 s, horizon: 3 steps, {mode}}}
state:
  p: {{range: [0, 2], clamp: true}}
  q: {{range: [-9, 9]}}
control:
  a: {{range: [-1, 1]}}
flow:
  p: {p}
  q: {q}
held:
  h: {{value: "{h}", before: 0}}
init:
  mixture:
    - {{name: any, draw: {{p: "uniform(0, 2)", q: 0}}}}
"""
"""A system whose states are at the ends of a clamp, or of a condition, at many plans of a grid."""

_ends = st.sampled_from([-1, 0, 0.5, 1, 2])
_read = ["p", "q", "p + q", "q - 0.5 * p", "-p", "1"]
_steered = [*_read, "a", "2 * a", "0.5 * a", "p + a", "q - a"]


def _pieces(terms: list[str]) -> st.SearchStrategy[str]:
    term = st.sampled_from(terms)
    cond = st.builds("{} {} {}".format, term, st.sampled_from(["<=", "<", ">=", ">"]), _ends)
    return st.recursive(
        term,
        lambda inner: (
            st.builds("(if {} then {} else {})".format, cond, inner, inner)
            | st.builds("ind({})".format, cond)
            | st.builds("clip({} + {}, 0, 1)".format, inner, term)
            | st.builds("max({}, {})".format, inner, inner)
        ),
        max_leaves=3,
    )


_wishes = st.builds("{} {} {}".format, st.sampled_from("pqh"), st.sampled_from(["<=", ">=", ">"]), _ends)
_windows = st.sampled_from(["always[0 s, 3 s]", "eventually[1 s, 3 s]", "eventually[3 s, 3 s]"])
_wanted = st.builds("{} {} and eventually[0 s, 3 s] {}".format, _windows, _wishes, _wishes)
EULER = "integrator: euler, substeps: 1"


@pytest.mark.apart
@example(EULER, "a", "ind(p <= 0)", "q", "eventually[0 s, 3 s] q >= 1", 1.0)
@example(EULER, "a", "if p > 0 then 0 else 1", "q", "eventually[0 s, 3 s] q >= 1", 1.0)
@example(EULER, "ind(q <= 0)", "a", "p", "always[0 s, 3 s] q >= 0 and eventually[0 s, 3 s] p >= 2", 0.0)
@example("discrete: true", "p", "2 * a", "clip(p + q, 0, 1)", "eventually[1 s, 3 s] q >= 1.5", 0.5)
@given(
    *(st.sampled_from([EULER, "discrete: true"]), _pieces(_steered), _pieces(_steered), _pieces(_read)),
    *(_wanted, st.sampled_from([0.0, 0.5, 1.0, 2.0])),
)
def test_no_proof_is_contradicted_at_the_boundary_of_a_condition(
    tmp_path_factory: pytest.TempPathFactory, mode: str, p: str, q: str, h: str, text: str, start: float
) -> None:
    path = tmp_path_factory.mktemp("piecewise") / "piecewise.yaml"
    path.write_text(PIECEWISE.format(mode=mode, p=p, q=q, h=h))
    system = System.load(path)
    task = Task.of(Spec.parse(Source("piecewise.stl", f"signal p, q, h\nrequire r: {text}")), system)
    task.__dict__["native"] = None
    x0 = torch.zeros(1, len(system.names), dtype=torch.float64)
    x0[:, system.names.index("p")] = start
    plans = torch.tensor(list(product((-1.0, -0.5, 0.0, 0.25, 1.0), repeat=3))).double()[..., None]
    best = float(task.judge(x0.expand(len(plans), -1), plans, states=False).rho.max())
    found = plan(task, x0, "milp", budget=PlanBudget(5.0))
    assert not (best >= 0.0 and bool(found.infeasible)), (best, text)
    if bool(found.satisfied):
        assert float(task.robustness(system.rollout(x0, found.plans))) >= -1e-6


def test_the_greatest_robustness_is_found(cart: System) -> None:
    """From rest the cart reaches p = 0 + 1 + 2 + 2 + ... under full acceleration."""
    task = task_of(cart, "eventually[0 s, 3 s] p > 1")
    x0 = torch.zeros(1, 3, dtype=torch.float64)
    found = plan(task, x0, "milp", budget=PlanBudget(5.0, target=torch.inf))
    assert float(found.rho) == pytest.approx(2.0, abs=1e-3)  # p(3) = 0 + 0 + 1 + 2
    assert plan(task_of(cart, "eventually[0 s, 3 s] p > 3.5"), x0, "milp").infeasible.tolist() == [True]


def test_a_margin_of_exactly_zero_is_a_plan(cart: System) -> None:
    """Full acceleration alone reaches p = 3 within 3 s; solvers stay beside a boundary, plans may not."""
    found = plan(task_of(cart, "eventually[0 s, 3 s] p >= 3"), torch.zeros(1, 3), "milp")
    assert found.satisfied.tolist() == [True]
    assert not bool(found.infeasible.any())


def test_an_expression_that_is_not_linear_is_named(cart: System) -> None:
    with pytest.raises(UsageError, match=r"cannot encode p \* v"):
        plan(task_of(cart, "always[0 s, 5 s] p * v < 1"), torch.zeros(1, 3), "milp")


def test_a_choice_stays_within_the_bounds_of_its_values(cart: System) -> None:
    """Each big-M follows from these bounds. After a jump they must not be wider than before and after it."""
    task = task_of(cart, "eventually[0 s, 5 s] n > 1")
    encoding, _ = milp._encoded(task, torch.zeros(3), 0.0, tight=True)
    assert encoding.model.bounds(encoding.rows[-1]["n"].form) == (0.0, 2.0)


def test_what_a_constant_decides_is_not_encoded(cart: System) -> None:
    start = torch.tensor([1.0, 0.0, 0.0])
    plain = milp._encoded(task_of(cart, "always[0 s, 5 s] p < 9"), start, 0.0, tight=True)[0]
    task = task_of(cart, "p > 0 or eventually[0 s, 5 s] p % 2 > 1")
    assert len(milp._encoded(task, start, 0.0, tight=True)[0].model.arrays().lower) == len(
        plain.model.arrays().lower
    )


def test_a_search_first_leaves_its_misses_to_the_program(
    cart: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    x0 = torch.tensor([[0.0, 0.0, 0.0], [-4.0, -2.0, 0.0]])
    task, solved = task_of(cart, "eventually[0 s, 3 s] p > 1"), []
    usual = milp.Milp._solve

    def spy(self: milp.Milp, search: PlanSearch, row: int, highs: object) -> None:
        solved.append(row)
        usual(self, search, row, highs)

    monkeypatch.setattr(milp.Milp, "_solve", spy)
    found = plan(task, x0, "milp", tries=200)
    assert found.satisfied.tolist() == [True, False]
    assert found.infeasible.tolist() == [False, True]
    assert solved == [1]


def test_a_stop_interrupts_the_solver(cart: System) -> None:
    """The limit counts processor time, and is asked for while HiGHS is at work."""
    asked = []

    def stop() -> bool:
        asked.append(True)
        return len(asked) > 3  # beginning, and before the solve; then while it runs

    task = task_of(cart, "eventually[0 s, 3 s] (abs(p) > 1.2 and eventually[0 s, 2 s] abs(v) > 1.9)")
    found = plan(task, torch.zeros(1, 3), "milp", budget=PlanBudget(5.0, target=torch.inf, stop=stop))
    assert len(asked) > 3
    assert not bool(found.infeasible.any())


def test_without_budget_nothing_is_claimed(cart: System) -> None:
    task = task_of(cart, "eventually[0 s, 3 s] abs(p) > 1")
    found = plan(task, torch.zeros(1, 3), "milp", budget=PlanBudget(1e-6))
    assert not bool(found.infeasible.any() | found.satisfied.any())
