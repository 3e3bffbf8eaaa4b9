"""Plans of short traces in C, against the same plans in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.formula_strategies import GRID, formulas, traces
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.graph import signal_plan
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.lower import lower
from stlc.monitor.verdict import Monitor

SPEC = """signal x, y
require short: always[0 s, 6 s] (x > y and x < 3)
require past_the_end: eventually[3 s, inf) (x - 2 * y > 1 and not abs(x) > 3)
require apart: always[1 s, 4 s] (2 - x > 0 or x + y > 1 or 3 * x < 8 - y)
require twice: (always[0 s, 3 s] x > 0) -> eventually[2 s, 5 s] x * y < 4
"""


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stlc.compile.backends.array.numpy_ops._MANY", 1)


def both(plan, env) -> tuple[list[np.ndarray] | None, list[np.ndarray]]:
    """Values of the formulas in C, and in NumPy."""
    fused, values = plan._fused, plan.values(env)
    found = fused.run(env) if fused is not None else None
    return found, [values[root] for root in plan.schedule.roots]


@settings(max_examples=150)
@given(
    st.lists(formulas(), min_size=1, max_size=3), traces(), st.sampled_from(("truncate", "lower", "upper"))
)
def test_c_gives_the_values_of_numpy(given_formulas, env, end) -> None:
    lowered = tuple(lower(formula, GRID, []) for formula in given_formulas)
    env = {name: np.ascontiguousarray(x) for name, x in env.items()}
    samples = len(next(iter(env.values())))
    plan = signal_plan(lowered, samples, range(samples), end).plan
    found, expected = both(plan, env)
    for mine, other in zip(found or (), expected, strict=bool(found)):
        np.testing.assert_array_equal(mine, other)


@pytest.mark.parametrize("samples", [1, 2, 3, 7, 40])
@pytest.mark.parametrize("traces", [1, 3])
@pytest.mark.parametrize("end", ["truncate", "lower", "upper"])
def test_every_step_that_c_has(samples: int, traces: int, end) -> None:
    rules = Monitor(SPEC, dt=1.0).compiled.requirements
    env = dict(zip("xy", np.random.default_rng(samples).normal(1, 2, (2, samples, traces)), strict=True))
    plan = signal_plan(tuple(rule.formula for rule in rules), samples, range(samples), end).plan
    found, expected = both(plan, env)
    assert found is not None or plan.beyond
    for mine, other in zip(found or (), expected, strict=bool(found)):
        np.testing.assert_array_equal(mine, other)


def test_nan_wins_as_in_numpy() -> None:
    rule = Monitor("signal x\nrequire r: always[0 s, 2 s] (x > 0 or x < 5)", dt=1.0).compiled.requirements[0]
    x = np.array([1.0, np.nan, 3.0, 4.0, np.inf, 2.0, 1.0])[:, None]
    found, expected = both(signal_plan((rule.formula,), 7, range(7), "truncate").plan, {"x": x})
    assert found is not None
    np.testing.assert_array_equal(found[0], expected[0])


@pytest.mark.parametrize("kind", ["read only", "gaps", "float32", "big-endian"])
def test_arrays_that_c_cannot_read_are_numpys(kind: str) -> None:
    rule = Monitor("signal x, y\nrequire r: x > y", dt=1.0).compiled.requirements[0]
    plan = signal_plan((rule.formula,), 4, range(4), "truncate").plan
    x = {
        "read only": np.ones((4, 1)),
        "gaps": np.ones((4, 2))[:, :1],
        "float32": np.ones((4, 1), np.float32),
        "big-endian": np.ones((4, 1), ">f8"),
    }[kind]
    x.flags.writeable = kind != "read only"
    env = {"x": x, "y": np.zeros((4, 1))}
    assert plan._fused is not None
    assert plan._fused.run(env) is None
    assert plan.roots(env)[0].tolist() == [[1.0]] * 4


def test_arrays_without_traces_and_of_other_lengths_are_numpys() -> None:
    rule = Monitor("signal x\nrequire r: x > 0", dt=1.0).compiled.requirements[0]
    plan = signal_plan((rule.formula,), 4, range(4), "truncate").plan
    assert plan._fused is not None
    assert plan._fused.run({"x": np.ones((4, 0))}) is None
    assert plan._fused.run({"y": np.ones((4, 1)), "x": np.ones((3, 1))}) is None
    assert plan.roots({"x": np.ones((4, 0))})[0].shape == (4, 0)


def test_long_traces_and_many_are_numpys() -> None:
    rule = Monitor("signal x\nrequire r: x > 0", dt=1.0).compiled.requirements[0]
    plan = signal_plan((rule.formula,), 40_000, range(40_000), "truncate").plan
    assert plan.ops is NUMPY
    assert plan._fused is None
