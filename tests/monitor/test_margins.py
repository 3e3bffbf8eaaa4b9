"""Margins of traces side by side are those of an `Online` each, and of the traces so far, judged anew."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.monitor.instants import rule_bounds
from stlc.monitor.online.margins import Margins
from stlc.monitor.online.recompute import GrowingBounds
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
def test_margins_are_those_of_monitors_side_by_side(formulas: list[str], seed: int, samples: int) -> None:
    judge = monitor(formulas)
    compiled = judge.compiled
    data = np.random.default_rng(seed).uniform(-1, 1, (samples, 2, TRACES)).round(2)
    margins = Margins(compiled.requirements, compiled.grid.horizon)
    alone = [judge.online() for _ in range(TRACES)]
    for k in range(samples):
        margins.push({"x": data[k, 0], "y": data[k, 1]})
        for trace, online in enumerate(alone):
            online.push({"x": float(data[k, 0, trace]), "y": float(data[k, 1, trace])})
        found = margins.evaluate()
        for rule in compiled.requirements:
            for trace, online in enumerate(alone):
                known = online.standing(rule.name)
                assert found[rule.name].status(trace) == known.status
                assert found[rule.name].violated[trace] == known.fails
            low, high = anew(judge, rule, data[: k + 1])
            assert np.array_equal(found[rule.name].low, low)
            assert np.array_equal(found[rule.name].high, high)


def anew(judge: Monitor, rule, data):  # type: ignore[no-untyped-def]
    """The least bounds over the windows that hold the last sample, from all samples at once."""
    last, horizon = len(data) - 1, judge.compiled.grid.horizon
    starts = range(1)
    if rule.windowed and not rule.absolute:
        starts = range(max(last - max(horizon, rule.reach), 0), last + 1)
    ends = []
    for trace in range(TRACES):
        columns = {"x": data[:, 0, trace, None], "y": data[:, 1, trace, None]}
        ends.append(GrowingBounds(rule, horizon, "open").live(columns, starts))
    return [low.min() for low, _ in ends], [high.min() for _, high in ends]


@pytest.mark.parametrize("often", [1, 3, 7, 100])
def test_looking_seldom_counts_the_same(often: int) -> None:
    judge = monitor(list(FORMULAS[:6]))
    compiled = judge.compiled
    data = np.random.default_rng(0).uniform(-1, 1, (150, 2, TRACES))
    margins = Margins(compiled.requirements, compiled.grid.horizon)
    for k, sample in enumerate(data):
        margins.push({"x": sample[0], "y": sample[1]})
        if k % often == often - 1:
            margins.evaluate()
    found = margins.evaluate()
    for rule in compiled.requirements:
        low, high = anew(judge, rule, data)
        assert np.array_equal(found[rule.name].low, low)
        assert np.array_equal(found[rule.name].high, high)
        _, every = rule_bounds(rule, Record({"x": data[:, 0], "y": data[:, 1]}, NUMPY), range(150), 4, "open")
        assert np.array_equal(found[rule.name].violated, (every < -TOLERANCE).sum(0))


def test_memory_is_bounded_by_the_windows() -> None:
    compiled = monitor(["always[0, T] x > 0", "always[0, T] historically[0, 2 s] y > 0"]).compiled
    margins = Margins(compiled.requirements, compiled.grid.horizon)
    for _ in range(1000):
        margins.push({"x": np.ones(2), "y": np.ones(2)})
        margins.evaluate()
    assert margins._history.samples == 1000
    assert margins._history.samples - margins._history.first <= 128


def test_a_requirement_of_nothing_has_margins() -> None:
    compiled = Monitor("signal x\nrequire a: true", dt=1, horizon=4).compiled
    margins = Margins(compiled.requirements, compiled.grid.horizon)
    margins.push({"x": np.zeros(2)})
    assert margins.evaluate()["a"].status(1) == "satisfied"
