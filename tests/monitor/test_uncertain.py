"""Signals with errors: bounds, verdicts that hold for every error, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stlc.diagnostics import UsageError
from stlc.monitor.uncertain import Uncertainty
from stlc.monitor.verdict import Monitor

SPEC = """
signal x [m]
signal v [km/h]
signal p: real[2] [m]
signal on: bool
require near: always x < 2 m
require fast: eventually v > 36 km/h
require mixed: always (on -> norm(p) < 1 m + 0.5 s * v)
"""


def signals(samples: int = 5, traces: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {
        "x": rng.uniform(0, 2, (traces, samples)),
        "v": rng.uniform(20, 40, (traces, samples)),
        "p": rng.uniform(-2, 2, (traces, samples, 2)),
        "on": rng.integers(0, 2, (traces, samples)),
    }


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("0.1m", Uncertainty(0.1)),
        (" 2 % ", Uncertainty(relative=0.02)),
        ("3", Uncertainty(3.0)),
        ("1.5e-3 km", Uncertainty(1.5e-3)),
    ],
)
def test_amounts_are_read(text: str, wanted: Uncertainty) -> None:
    found = Uncertainty.parse(text)
    assert (found.absolute, found.relative) == (wanted.absolute, wanted.relative)


@pytest.mark.parametrize("text", ["", "m", "-1m", "1 qq", "nan", "1e999", "0.1m 2%"])
def test_other_texts_are_no_amount(text: str) -> None:
    with pytest.raises(ValueError, match=r"amount|unit"):
        Uncertainty.parse(text)


def test_amounts_are_written_as_they_are_read() -> None:
    for text in ("0.1 m", "2 %", "3"):
        assert str(Uncertainty.parse(text)) == text


@pytest.mark.parametrize(
    "text",
    [
        "abs(log(x)) >= 0",
        "min(log(x), 5) <= 5",
        "sin(1 / x) <= 1",
        "(1 / x) % 2 >= 0",
        "max(sqrt(x), 0) >= 0",
    ],
)
def test_a_value_that_may_be_undefined_decides_nothing(text: str) -> None:
    """A function with a bounded range does not make a value of what has none."""
    monitor = Monitor(f"signal x\nrequire r: always {text}", dt=1.0)
    errors = {"x": Uncertainty(0.01)}
    assert monitor.check({"x": [0.5, 1.0]}, uncertain=errors).overall == "satisfied"
    assert monitor.check({"x": [0.0, -1.0, 0.0]}, uncertain=errors).overall == "inconclusive"


def test_bounds_by_hand() -> None:
    given = {"x": [1.0, 1.5], "v": [40.0, 30.0], "p": np.zeros((2, 2)), "on": [0.0, 1.0]}
    errors = {"x": Uncertainty.parse("10cm"), "v": Uncertainty.parse("10%"), "p": Uncertainty.parse("0.3")}
    verdict = Monitor(SPEC, dt=0.1).check(given, uncertain=errors)
    assert verdict["near"].bounds == pytest.approx((0.4, 0.6))
    assert verdict["fast"].bounds == pytest.approx((0.0, 8.0), abs=1e-9)
    least = 1 + 0.5 * 27 / 3.6 - np.hypot(0.3, 0.3)
    assert verdict["mixed"].bounds == pytest.approx((least, 1 + 0.5 * 33 / 3.6))
    assert verdict["near"].robustness == pytest.approx(0.4)
    assert [judged.overall for judged in verdict] == ["satisfied"] * 3


def test_verdicts_are_satisfied_violated_or_open() -> None:
    monitor = Monitor("signal x [m]\nrequire low: always x < 2 m\n", dt=0.1)
    for value, wanted in (
        (1.5, "satisfied"),
        (1.95, "inconclusive"),
        (2.05, "inconclusive"),
        (2.5, "violated"),
    ):
        verdict = monitor.check({"x": [value]}, uncertain={"x": Uncertainty(0.1)})
        assert verdict.overall == wanted


def test_strict_predicates_without_tolerance() -> None:
    monitor = Monitor("signal x\nrequire r: always x > 0\n", dt=0.1)
    for value, wanted in ((1.0, "inconclusive"), (1.5, "satisfied"), (-1.5, "violated")):
        verdict = monitor.check({"x": [value]}, uncertain={"x": Uncertainty(1.0)}, tolerance=0.0)
        assert verdict.overall == wanted


def test_errors_of_0_change_no_verdict_and_no_robustness_but_rounding() -> None:
    monitor, given = Monitor(SPEC, dt=0.1), signals()
    plain = monitor.check(given)
    found = monitor.check(given, uncertain={"x": Uncertainty(0.0), "p": Uncertainty(relative=0.0)})
    for one, other in zip(plain, found, strict=True):
        assert one.statuses == other.statuses
        np.testing.assert_allclose(other.low, one.low, atol=1e-14)
        assert (other.low <= one.low).all()
        assert (one.high <= other.high).all()


def test_every_error_within_the_limits_has_a_robustness_within_the_bounds() -> None:
    monitor, given = Monitor(SPEC, dt=0.1), signals()
    errors = {"x": Uncertainty(0.2), "v": Uncertainty(relative=0.3), "p[1]": Uncertainty(0.7)}
    verdict = monitor.check(given, uncertain=errors)
    rng = np.random.default_rng(2)
    for _ in range(50):
        drawn = {
            "x": given["x"] + 0.2 * rng.choice([-1, 1, rng.uniform(-1, 1)], given["x"].shape),
            "v": given["v"] * (1 + 0.3 * rng.choice([-1, 1, rng.uniform(-1, 1)], given["v"].shape)),
            "p": given["p"] + [0.0, 0.7] * rng.choice([-1, 1], given["p"].shape),
            "on": given["on"],
        }
        for bounds, point in zip(verdict, monitor.check(drawn), strict=True):
            assert (bounds.low - 1e-12 <= point.low).all()
            assert (point.high <= bounds.high + 1e-12).all()


def test_unknown_samples_stay_unknown() -> None:
    monitor = Monitor("signal x\nrequire r: always x < 2\nrequire s: eventually x > 0\n", dt=0.1)
    verdict = monitor.check({"x": [1.0, np.nan, 1.5]}, uncertain={"x": Uncertainty(0.1)})
    assert verdict["r"].bounds == (-np.inf, pytest.approx(0.6))
    assert verdict["s"].overall == "satisfied"


def test_a_short_trace_stays_open() -> None:
    monitor = Monitor("signal x\nrequire r: always[0 s, 1 s] x < 2\n", dt=0.1)
    verdict = monitor.check({"x": [1.0, 1.5]}, uncertain={"x": Uncertainty(0.1)})
    assert verdict["r"].bounds == (-np.inf, pytest.approx(0.6))


def test_planning_windows_with_an_end() -> None:
    monitor = Monitor("signal x\nrequire r: always[0, T] eventually[0, end] x > 0\n", dt=0.1, horizon=0.3)
    x = np.sin(np.arange(12.0))
    verdict = monitor.check({"x": x}, uncertain={"x": Uncertainty(0.05)})
    plain = monitor.check({"x": x})
    np.testing.assert_allclose(verdict["r"].low, plain["r"].low - 0.05, atol=1e-12)
    np.testing.assert_allclose(verdict["r"].high, plain["r"].high + 0.05, atol=1e-12)


def test_an_assumption_counts_where_it_may_hold() -> None:
    monitor = Monitor("signal x\nassume a: x > 0\nrequire r: always x > -5\n", dt=0.1)
    found = monitor.check({"x": [[0.05, 1.0], [-0.05, 1.0], [-0.5, 1.0]]}, uncertain={"x": Uncertainty(0.1)})
    assert list(found.status) == ["satisfied", "satisfied", "out of scope"]


def test_the_unit_of_an_error_is_a_difference() -> None:
    monitor = Monitor("signal t [degC]\nrequire warm: always t > 20 degC\n", dt=0.1)
    for unit in ("K", ""):
        verdict = monitor.check({"t": [21.0]}, uncertain={"t": Uncertainty.parse(f"0.25{unit}")})
        assert verdict["warm"].bounds == pytest.approx((0.75, 1.25))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("xx", "1m", "no signal `xx`"),
        ("x", "1s", r"`x` is in \[m\], not in \[s\]"),
        ("on", "1", "type bool"),
        ("p[7]", "1m", r"no signal `p\[7\]`"),
    ],
)
def test_what_does_not_fit_is_refused(name: str, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Monitor(SPEC, dt=0.1).check(signals(), uncertain={name: Uncertainty.parse(text)})


def test_means_have_no_bounds() -> None:
    with pytest.raises(UsageError, match="exact semantics only"):
        Monitor(SPEC, dt=0.1).check(signals(), uncertain={"x": Uncertainty(0.1)}, semantics="agm")


def test_python_functions_are_refused() -> None:
    lines = (
        "extern fn hand(q: real[2]) -> real[2] [m]",
        "signal a, b [rad]",
        "require r: always norm(hand([a, b])) > 0 m",
    )
    arm = Path(__file__).parents[1] / "data" / "arm.yaml"
    monitor = Monitor("\n".join(lines), system=str(arm))
    with pytest.raises(UsageError, match="Python function") as caught:
        monitor.check({"a": np.zeros(3), "b": np.zeros(3)}, uncertain={"a": Uncertainty(0.1)})
    assert caught.value.diagnostics[0].span is not None
