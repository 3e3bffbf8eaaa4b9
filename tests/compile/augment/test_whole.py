"""Requirements on a whole mission are those on every window of it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from helpers.mission_strategies import augmented, walks
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import Compiled, compile_spec
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.grammar.spec import Spec
from stlc.source import Source

WINDOW, END, BATCH = 5, 17, 200
STARTS = END - WINDOW + 1
ON_WINDOWS = (
    "always[0, T] x > 0",
    "eventually[0, T] x > 0.5",
    "x > -1 until[0, T] y > 0",
    "always[0, T - 0.2 s] (x > 0 -> eventually[0, 0.2 s] y > 0)",
    "(always[0, T] x > -1) and (eventually[0, T] y > 0)",
    "(always[0, T] x > 0) or (eventually[0, T - 0.1 s] always[0, 0.1 s] y > 0)",
    "always[0, T] (x > 0.5 -> once[0, 0.3 s] y > 0)",
    "always[0.2 s, T] x > 0",
)
FROM_START = (
    "eventually[0, 0.8 s] x > 0.5",
    "always[0.3 s, 1 s] x > -1",
    "x > 0",
    "x > 0 until[0, 1 s] y > 0",
)


def compiled(requirement: str, grid: Grid, tag: str = "") -> Compiled:
    text = f"signal x, y\n{tag}\nrequire a: {requirement}\n"
    return compile_spec(Spec.parse(Source("s.stl", text)), grid=grid)


def columns(seed: int) -> dict[str, np.ndarray]:
    """Signals of a mission, and of as many samples again, which nothing is required of."""
    return {name: np.asarray(each) for name, each in walks(seed, BATCH, 2 * END + 2).items() if name in "xy"}


def planned(found: Compiled, signals: dict[str, np.ndarray]) -> np.ndarray:
    """Truth of the formula of plans at every step of the mission, (steps, batch)."""
    env = augmented(found.timers, signals)
    (margins,) = evaluate([found.requirements[0].formula], env, ops=NUMPY, count=END + 1)
    return np.broadcast_to(margins, (END + 1, BATCH)) >= -TOLERANCE


@pytest.mark.apart
@pytest.mark.parametrize("requirement", [*ON_WINDOWS, *FROM_START])
@pytest.mark.parametrize("tag", ["", "@safety"])
@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_plan_satisfies_it_iff_every_window_of_the_mission_does(
    requirement: str, tag: str, seed: int
) -> None:
    signals = columns(seed)
    grid = Grid(Fraction(1, 10), WINDOW)
    windows = compile_spec(
        Spec.parse(Source("s.stl", f"signal x, y\nrequire a: {requirement}\n")), grid=grid, purpose="check"
    )
    count = STARTS if requirement in ON_WINDOWS else 1
    mission = {name: each[: END + 1] for name, each in signals.items()}
    (margins,) = evaluate([windows.requirements[0].formula], mission, ops=NUMPY, count=count)
    held = (np.broadcast_to(margins, (count, BATCH)) >= -TOLERANCE).all(0)
    assert 0 < held.sum() < BATCH or requirement == "always[0, T] x > 0"
    found = compiled(requirement, Grid(Fraction(1, 10), WINDOW, END, END), tag)
    np.testing.assert_array_equal(planned(found, signals).all(0), held)


def test_nothing_is_required_after_the_end() -> None:
    found = compiled("always[0, T] x > 0", Grid(Fraction(1, 10), WINDOW, END, END))
    signals = {"x": np.ones((2 * END + 2, BATCH)), "y": np.ones((2 * END + 2, BATCH))}
    signals["x"][END + 1 :] = -1.0
    assert planned(found, signals).all()
    signals["x"][END] = -1.0
    assert not planned(found, signals).any()


@pytest.mark.parametrize(
    ("tag", "again"), [("@safety", True), ("", False)], ids=["safety comes again", "others are dropped"]
)
def test_what_is_lost_is_required_no_more(tag: str, again: bool) -> None:
    found = compiled("always@[0, 1.7 s] x > 0", Grid(Fraction(1, 10), WINDOW, END, END), tag)
    signals = {"x": np.ones((2 * END + 2, BATCH)), "y": np.ones((2 * END + 2, BATCH))}
    signals["x"][3] = signals["x"][9] = -1.0
    steps = planned(found, signals)[:, 0]
    assert not steps[:4].any(), "asked for until it is violated"
    assert (not steps[4:10].any()) if again else steps[4:].all()
    assert steps[10:].all()


def test_a_requirement_that_states_cannot_hold_stays_on_windows() -> None:
    found = compiled("eventually[0, T] (x > 0 and next(y > 0))", Grid(Fraction(1, 10), WINDOW, END, END))
    assert found.requirements[0].windowed or found.requirements[0].absolute
