"""Margins at the latest sample are those of the trace so far, judged anew."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.monitor.instants import rule_bounds
from stlc.monitor.online.online import How, Margin
from stlc.monitor.online.tally import Asked
from stlc.monitor.values import Record
from stlc.monitor.verdict import Monitor

TRACES = 3
FORMULAS = (
    "always[0, T] x > 0",
    "eventually[0, T] x > 0.5",
    "always[0, T] (x > 0 -> eventually[0, 2 s] y > 0)",
    "always[0, T - 1 s] (x > -0.8 until[0, 1 s] y > -0.5)",
    "eventually[0, T] always[0, end] x > -0.3",
    "always[0, T] historically[0, 2 s] x > -0.9",
    "x > -0.5 and eventually[1 s, 3 s] y > 0",
    "always x > -0.97",
    "eventually x > 0.97",
    "always@[2 s, 5 s] x > -0.9",
    "always[0, T] (eventually@[3 s, 6 s] y > 0 or x > 0)",
    "always[0, T] once y > 0.3",
)
names = st.lists(st.sampled_from(FORMULAS), min_size=1, max_size=3, unique=True)


def monitor(formulas: list[str]) -> Monitor:
    lines = [f"require r{i}: {formula}" for i, formula in enumerate(formulas)]
    return Monitor("\n".join(["signal x, y", *lines]), dt=1, horizon=4)


@settings(deadline=None, max_examples=15)
@given(names, st.integers(0, 2**32 - 1), st.integers(1, 14))
def test_margins_are_those_of_the_trace_so_far(formulas: list[str], seed: int, samples: int) -> None:
    judge = monitor(formulas)
    compiled = judge.compiled
    data = np.random.default_rng(seed).uniform(-1, 1, (samples, 2, TRACES)).round(2)
    alone = [judge.online() for _ in range(TRACES)]
    for k in range(samples):
        for trace, online in enumerate(alone):
            online.push({"x": float(data[k, 0, trace]), "y": float(data[k, 1, trace])})
        for rule in compiled.requirements:
            found = [online.margin(rule.name) for online in alone]
            for margin, online in zip(found, alone, strict=True):
                known = online.standing(rule.name)
                assert (margin.violated, margin.status) == (known.fails, known.status)
            low, high = anew(judge, rule, data[: k + 1])
            assert [margin.low for margin in found] == low
            assert [margin.high for margin in found] == high


def anew(judge: Monitor, rule, data):  # type: ignore[no-untyped-def]
    """The least bounds over the windows that hold the last sample, from all samples at once."""
    last, horizon = len(data) - 1, judge.compiled.grid.horizon
    starts = range(1)
    if rule.windowed and not rule.absolute:
        starts = range(max(last - max(horizon, rule.reach), 0), last + 1)
    ends = []
    for trace in range(TRACES):
        columns = {"x": data[:, 0, trace, None], "y": data[:, 1, trace, None]}
        ends.append(Asked([rule], 0, False, horizon).bounds(columns, starts).min(axis=0))
    return [low for low, _ in ends], [high for _, high in ends]


@pytest.mark.parametrize("often", [1, 3, 7, 100])
def test_looking_seldom_counts_the_same(often: int) -> None:
    judge = monitor(list(FORMULAS[:6]))
    compiled = judge.compiled
    data = np.random.default_rng(0).uniform(-1, 1, (150, 2, TRACES))
    alone = [judge.online() for _ in range(TRACES)]
    for first in range(0, len(data), often):
        for trace, online in enumerate(alone):
            online.push_block(data[first : first + often, :, trace])
            if often < 100:
                online.margin("r0")
    for rule in compiled.requirements:
        found = [online.margin(rule.name) for online in alone]
        low, high = anew(judge, rule, data)
        assert [margin.low for margin in found] == low
        assert [margin.high for margin in found] == high
        _, every = rule_bounds(rule, Record({"x": data[:, 0], "y": data[:, 1]}, NUMPY), range(150), 4, "open")
        assert [margin.violated for margin in found] == (every < -TOLERANCE).sum(0).tolist()


def test_a_requirement_of_nothing_has_a_margin() -> None:
    online = Monitor("signal x\nrequire a: true", dt=1, horizon=4).online()
    online.push_block(np.zeros((1, 0)))
    assert online.margin("a") == Margin("satisfied", np.inf, np.inf, 0)


@pytest.mark.parametrize("condition", ["x * x - y * y > 0", "x * x - y * y > 0 or freeze z = x in x < z"])
def test_a_margin_that_is_no_number_is_unknown(condition: str) -> None:
    online = Monitor(f"signal x, y\nrequire a: always[3, 5] ({condition})", dt=1).online(How("all"))
    online.push_block([(1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (1e300, 1e300)])
    margin = online.margin("a")
    assert (margin.status, margin.violated) == ("inconclusive", 0)
    assert (margin.low, margin.high) == (-np.inf, np.inf)


def test_before_its_first_start_a_requirement_has_no_bounds() -> None:
    online = Monitor("signal x\nrequire a: x > 0\nrequire b: freeze z = x in x >= z", dt=1).online(How(2))
    for samples in range(2):
        assert online.samples == samples
        for name in online.requirements:
            assert online.margin(name) == Margin("inconclusive", np.inf, np.inf, 0)
        online.push([1.0])
