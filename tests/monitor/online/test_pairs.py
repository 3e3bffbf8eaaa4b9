"""Many requirements in one array: each as it is alone, whatever stands beside it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from stlc.diagnostics import TraceError
from stlc.monitor.online.online import How
from stlc.monitor.verdict import Monitor

HEAD = "signal a\nsignal b\nsignal n: int\n"
REQUIREMENTS = {
    "now": "a > 0",
    "constant": "true",
    "window": "a > 0 -> eventually[0, T] b > 0",
    "other_window": "always[0, T] (a > 0 or eventually[0.1 s, 0.3 s] n == 1)",
    "beyond": "always[0, T] (a > -1 or eventually[0 s, 0.4 s] b > 0)",
    "met": "a > -1 until[0.2 s, 0.5 s] b > 0",
    "past": "always[0, T] (once[0 s, 0.2 s] a > 0 or historically[0 s, 0.3 s] b > 0)",
    "whole_past": "always[0, T] (once a > 1.5 or historically b > -1)",
    "met_before": "eventually[0, T] not (a > -1 since[0.2 s, inf] b > 0)",
    "short_past_since": "always[0, T] ((historically[0 s, 0.2 s] a > -1) since b > 1)",
    "edge": "always[0, T] (rise(a > 0) -> b > -1)",
    "step_before": "eventually[0, T] prev(b > 1)",
}
SAMPLES = 150


def signals(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = {name: rng.integers(-16, 16, SAMPLES) / 8 for name in ("a", "b")}
    return columns | {"n": rng.integers(0, 3, SAMPLES).astype(float)}


def monitor_of(names: list[str]) -> Monitor:
    body = "".join(f"require {name}: {REQUIREMENTS[name]}\n" for name in names)
    return Monitor(HEAD + body, dt=0.1, horizon=0.6)


@pytest.mark.parametrize(
    ("tolerance", "at"), [pytest.param(1e-6, None, marks=pytest.mark.apart), (0.0, "all")]
)
def test_every_requirement_is_as_it_is_alone(tolerance: float, at) -> None:
    whole, how = signals(1), How(at=at, tolerance=tolerance)
    together = monitor_of(list(REQUIREMENTS)).online(how)
    alone = {name: monitor_of([name]).online(how) for name in REQUIREMENTS}
    for k in range(SAMPLES):
        sample = {name: values[k] for name, values in whole.items()}
        assert together.push(sample) == sum(each.push(sample) for each in alone.values())
        assert list(together.verdicts()) == [each for one in alone.values() for each in one.verdicts()]
        for name in REQUIREMENTS:
            assert together.open_starts(name) == alone[name].open_starts(name)
    finished = together.finish()
    for name in REQUIREMENTS:
        assert finished[name] == alone[name].finish()[name]
        verdict = monitor_of([name]).check(whole, at=at, tolerance=tolerance)[name]
        assert (finished[name].low, finished[name].high) == verdict.bounds
        assert (finished[name].status, finished[name].instants) == (verdict.overall, verdict.instants)


def test_pieces_of_any_size() -> None:
    whole, monitor = signals(2), monitor_of(list(REQUIREMENTS))
    online, cuts = monitor.online(), [0, 1, 2, 40, 41, 140, SAMPLES]
    for low, high in pairwise(cuts):
        online.feed({name: values[low:high] for name, values in whole.items()})
    verdict, finished = monitor.check(whole), online.finish()
    for name in REQUIREMENTS:
        assert (finished[name].low, finished[name].high) == verdict[name].bounds
        assert finished[name].instants == verdict[name].instants


@pytest.mark.parametrize("value", [10**400, -(10**400), "high", [[1.0], [2.0, 3.0]]])
def test_what_is_no_number_is_refused(value: object) -> None:
    online = monitor_of(["now"]).online()
    with pytest.raises(TraceError, match="E603"):
        online.push({"a": value})
    with pytest.raises(TraceError, match="E603"):
        monitor_of(["now"]).check({"a": [value]})
    assert online.samples == 0


def test_none_is_an_unknown_number() -> None:
    online = monitor_of(["now"]).online()
    online.push({"a": None})
    assert online.gaps["a"].samples == 1
