"""Losses of plans in the world of a scenario, compared with values by hand; and margins as asked for."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from stlc.controller.guard.margins import MarginRequest, calibrated_margins, parse_margins
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError
from stlc.dynamics.load import parse_system
from stlc.dynamics.scenario import under
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """\
stlc: 1
name: belt
time: {dt: 0.5 s, horizon: 6 steps}
const: {drift: 0.5 m/s}
state: {p: {unit: m, range: [0, 20]}, q: {unit: m, range: [0, 20]}, left: {unit: s, range: [0, 9]}}
control: {u: {unit: m/s, range: [-2, 2]}}
flow: {p: u, q: drift, left: -1}
init: {mixture: [{draw: {p: "uniform(0, 2)", q: "uniform(0, 2)", left: 9}}]}
test: {agents: 4, replan: 3}
scenario:
  mild: {}
  windy: {disturb: {p: 0.1 m/s}}
  blurred: {noise: {q: "uniform(-0.2, 0.2)"}}
  slow: {model_mismatch: {drift: 0.9 m/s}}
"""
SPEC = """\
signal p, q
@safety
require p_low: always[0, T] p <= 10 m
@safety
require q_low: always[0, T] q <= 10 m
require q_up: eventually[0, T] q > 1 m
"""


def task_of(scenario: str) -> Task:
    decl = parse_system(Source("belt.yaml", SYSTEM), Path("belt.yaml"))
    return Task.of(Spec.parse(Source("a.stl", SPEC)), System(under(decl, scenario)))  # type: ignore[arg-type]


class Onward(Policy):
    """Moves on at 1 m/s."""

    def candidates(self, x0: Tensor) -> Tensor:
        return torch.ones((len(x0), 1, 6, 1), dtype=x0.dtype)


def margins(scenario: str, steps: int = 1) -> dict[str, float]:
    return dict(calibrated_margins(task := task_of(scenario), Onward(task), steps))


@pytest.mark.parametrize(
    ("scenario", "steps", "wanted"),
    [
        ("mild", 1, {}),
        ("windy", 1, {"p_low": 0.5 * 0.1}),  # what one step adds
        ("windy", 3, {"p_low": 3 * 0.5 * 0.1}),
        ("windy", 99, {"p_low": 6 * 0.5 * 0.1}),  # no plan is longer than the horizon
        ("slow", 1, {"q_low": 0.5 * 0.4}),
        ("mismatch-20", 1, {"p_low": 0.5 * 0.2, "q_low": 0.5 * 0.2 * 0.5}),
        ("mismatch-20", 3, {"p_low": 3 * 0.5 * 0.2, "q_low": 3 * 0.5 * 0.2 * 0.5}),
    ],
)
def test_a_margin_is_what_is_lost_until_the_guard_looks_again(
    scenario: str, steps: int, wanted: dict[str, float]
) -> None:
    found = margins(scenario, steps)
    assert set(found) == set(wanted)
    assert found == pytest.approx(wanted, abs=1e-6)


def test_noise_is_lost_where_a_plan_begins() -> None:
    """Loss of a system that believes to be lower than it is; 99 % of even noise of 0.2 m is 0.196 m."""
    assert margins("blurred") == {"q_low": pytest.approx(0.196, abs=0.003)}
    assert margins("blurred", 3) == margins("blurred")
    task = task_of("blurred")
    whole = calibrated_margins(task, Onward(task), 1, 1.0)
    assert whole["q_low"] == pytest.approx(0.2, abs=0.005)


def test_noise_on_actuators_loses_its_quantile() -> None:
    found = margins("disturb")  # 10 % of half the range: 0.2 m/s
    assert found == {"p_low": pytest.approx(2.326 * 0.2 * 0.5, rel=0.1)}


def test_without_a_safe_plan_nothing_is_measured() -> None:
    class Away(Policy):
        def candidates(self, x0: Tensor) -> Tensor:
            return torch.full((len(x0), 1, 6, 1), 9.0, dtype=x0.dtype)

    task = task_of("windy")
    assert calibrated_margins(task, Away(task)) == {}


def test_where_nothing_is_wrong_nothing_is_lost_but_digits(car_task: Task) -> None:
    class Anyhow(Policy):
        def candidates(self, x0: Tensor) -> Tensor:
            drawn = torch.rand((len(x0), car_task.horizon, 1), generator=torch.Generator().manual_seed(0))
            return (12.0 * drawn.to(x0) - 9.0)[:, None]

    assert calibrated_margins(car_task, Anyhow(car_task)) == {}


def test_margins_are_asked_for_by_number_by_name_or_measured() -> None:
    assert parse_margins([]) == MarginRequest()
    assert parse_margins(["0.2", "p_low=0.5", "0.3"]) == MarginRequest(0.3, {"p_low": 0.5})
    assert parse_margins(["auto", "q_low = 1"]) == MarginRequest(0.0, {"q_low": 1.0}, 0.99)
    assert parse_margins(["auto:95"]).share == 0.95
    policy = Onward(windy := task_of("windy"))
    assert parse_margins(["0.2", "q_low=0.5"]).of(windy, policy, "full") == {"p_low": 0.2, "q_low": 0.5}
    assert parse_margins(["auto", "q_low=0.5"]).of(windy, policy, "full", 3) == pytest.approx(
        {"p_low": 0.05, "q_low": 0.5}
    )
    assert parse_margins(["auto"]).of(windy, policy, "paper", 3) == pytest.approx({"p_low": 0.15})
    assert parse_margins(["auto"]).of(windy, policy, "none", 3) == {}
    assert parse_margins(["auto", "p_low=0"]).of(windy, policy, "full") == {}


@pytest.mark.parametrize(
    "text", ["", "much", "-1", "p_low=", "p_low=nan", "auto:", "auto:101", "inf", "a=b=1"]
)
def test_what_is_no_margin(text: str) -> None:
    with pytest.raises(UsageError, match=r"is no (margin|safety requirement)"):
        parse_margins([text]).of(task := task_of("mild"), Onward(task), "full")


def test_a_margin_of_what_is_no_safety_requirement() -> None:
    with pytest.raises(UsageError) as caught:
        parse_margins(["p_lo=1"]).of(task := task_of("mild"), Onward(task), "full")
    (found,) = caught.value.diagnostics
    assert found.help == ("did you mean `p_low`?", "safety requirements: p_low, q_low")
    with pytest.raises(UsageError, match="`q_up` is no safety requirement"):
        parse_margins(["q_up=1"]).of(task := task_of("mild"), Onward(task), "full")
