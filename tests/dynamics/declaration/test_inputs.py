"""Input signals: their values over time, and the numbers that determine them."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from stlc.dynamics.declaration.inputs import InputDecl, Interpolate
from stlc.units import Unit


def declared(interpolate: Interpolate, pieces: int, *, free: bool) -> InputDecl:
    """An input signal between -1 and 3 over 10 s."""
    return InputDecl("u", Unit(), -1.0, 3.0, pieces, interpolate, Fraction(10), free)


def drawn(decl: InputDecl, count: int = 20, seed: int = 0) -> np.ndarray:
    """Random numbers of an input signal, (count, columns); half of the values are whole."""
    numbers = decl.drawn(np.random.default_rng(seed).random((count, len(decl.columns))))
    numbers[::2, : decl.points] = np.round(numbers[::2, : decl.points])
    return numbers


def knots(decl: InputDecl, row: np.ndarray) -> np.ndarray:
    """Ends of the pieces, in seconds."""
    inner = row[decl.points :] if decl.free_times else np.linspace(0.0, 10.0, decl.pieces + 1)[1:-1]
    return np.array([0.0, *inner, 10.0])


@pytest.mark.parametrize(("pieces", "free"), list(product((1, 2, 3, 7), (False, True))))
def test_signals_are_what_scipy_and_numpy_interpolate(pieces: int, free: bool) -> None:
    times = np.linspace(0.0, 10.0, 101)
    for interpolate in ("hold", "linear", "pchip"):
        decl = declared(interpolate, pieces, free=free)
        numbers = drawn(decl)
        found = decl.at(numbers, times)
        assert found.shape == (20, 101)
        assert found.dtype == np.float64
        for row, values in zip(numbers, found, strict=True):
            at, points = knots(decl, row), row[: decl.points]
            match interpolate:
                case "hold":
                    wanted = points[np.searchsorted(at[1:-1], times + 1e-9, side="right")]
                case "linear":
                    wanted = np.interp(times, at, points)
                case _:
                    wanted = PchipInterpolator(at, points)(times)
            np.testing.assert_allclose(values, wanted, atol=1e-9)


@given(st.integers(1, 6), st.booleans(), st.sampled_from(("hold", "linear", "pchip")), st.integers(0, 99))
def test_a_signal_stays_within_its_values_and_after_its_duration(
    pieces: int, free: bool, interpolate: Interpolate, seed: int
) -> None:
    decl = declared(interpolate, pieces, free=free)
    numbers = drawn(decl, 3, seed)
    points = numbers[:, : decl.points]
    found = decl.at(numbers, np.array([-1.0, 0.0, *np.linspace(0.0, 12.0, 50)]))
    assert (found >= points.min(1, keepdims=True) - 1e-12).all()
    assert (found <= points.max(1, keepdims=True) + 1e-12).all()
    np.testing.assert_allclose(found[:, 0], points[:, 0])
    np.testing.assert_allclose(found[:, -1], points[:, -1])


def test_free_times_are_sorted_uniform_times() -> None:
    decl = declared("hold", 4, free=True)
    times = decl.drawn(np.random.default_rng(1).random((20_000, 7)))[:, 4:]
    assert (np.diff(times, axis=1) >= 0.0).all()
    np.testing.assert_allclose(times.mean(0), [2.5, 5.0, 7.5], atol=0.05)
    np.testing.assert_allclose(times[:, 0].std(), 10 * np.sqrt(3 / 80), atol=0.05)


def test_numbers_at_the_corners_of_the_unit_cube() -> None:
    decl = declared("linear", 3, free=True)
    corners = decl.drawn(np.array([[0.0] * 6, [1.0] * 6]))
    assert corners.tolist() == [[-1.0] * 4 + [10.0] * 2, [3.0] * 4 + [0.0] * 2]
    assert np.isfinite(decl.at(corners, np.linspace(0.0, 10.0, 11))).all()


def test_a_sample_at_a_switching_time_belongs_to_the_later_piece() -> None:
    decl = declared("hold", 10, free=False)
    steps = np.cumsum(np.full(100, 0.1))  # 0.1 + 0.1 + … misses the whole seconds by 1e-15
    found = decl.at(np.arange(10.0)[None], steps)[0]
    assert found[9::10].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 9.0]


def test_the_columns_of_a_signal() -> None:
    assert declared("hold", 2, free=True).columns == ("u_values[0]", "u_values[1]", "u_times[0]")
    assert declared("linear", 2, free=False).columns == ("u_values[0]", "u_values[1]", "u_values[2]")
