"""States in which a policy fails, as numbers and as a sentence."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stlc.rundir import RunDir
from stlc.view.held_out import HeldOut, draw_failures, load_held_out, region_text


def held(x0, each, names=None, requirements=None):
    each = np.asarray(each, dtype=float)
    names = names or tuple("abcdefg"[: x0.shape[1]])
    return HeldOut(
        names, requirements or tuple(f"r{i}" for i in range(each.shape[1])), x0, each.min(axis=1), each
    )


def boxed(seed=0, count=4000):
    """Failing exactly where kind = 1 and 2 <= a <= 4; b is noise."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, 2, count).astype(float)
    a, b = rng.uniform(0, 10, count), rng.uniform(0, 1, count)
    failing = (kind == 1) & (a >= 2) & (a <= 4)
    return held(np.stack([kind, a, b], axis=1), np.where(failing, -1.0, 1.0)[:, None]), failing


@pytest.mark.parametrize("seed", range(3))
def test_a_box_is_found(seed):
    data, failing = boxed(seed)
    weakness = data.weakness()
    assert weakness.failing == pytest.approx(failing.mean())
    assert weakness.inside > 0.97
    assert weakness.covered > 0.97
    assert {(c.column, c.op) for c in weakness.conditions} == {(0, "="), (1, ">="), (1, "<=")}
    assert weakness.axes[0] == 1


def test_shares_are_those_of_the_region():
    data, failing = boxed()
    weakness = data.weakness()
    region = np.logical_and.reduce([c.holds(data.x0) for c in weakness.conditions])
    assert weakness.inside == pytest.approx(failing[region].mean())
    assert weakness.covered == pytest.approx(region[failing].mean())


def test_the_worst_requirement_is_taken():
    x0 = np.random.default_rng(0).uniform(0, 1, (100, 2))
    each = np.ones((100, 3))
    each[:20, 2] = each[:5, 1] = -1
    assert held(x0, each).weakness().requirement == 2
    assert held(x0, each).weakness(0) is None


def test_everything_failing_has_no_region():
    x0 = np.random.default_rng(0).uniform(0, 1, (50, 2))
    weakness = held(x0, -np.ones((50, 1))).weakness()
    assert weakness.conditions == ()
    text = weakness.text(held(x0, -np.ones((50, 1))))
    assert text == "fails in 50 of 50 starts, in no region of their own"


def test_a_few_failures_make_no_region():
    data, _ = boxed()
    each = np.ones((4000, 1))
    each[:5] = -1
    assert held(data.x0, each).weakness().conditions == ()


def test_a_value_that_many_starts_share_is_named():
    """A sentinel in a continuous column, not an inequality that only it meets."""
    rng = np.random.default_rng(0)
    gap = np.where(rng.random(2000) < 0.3, -1.0, rng.uniform(0, 10, 2000))
    each = np.where(gap == -1, -1.0, 1.0)[:, None]
    weakness = held(np.stack([gap, rng.random(2000)], axis=1), each).weakness()
    assert [(c.column, c.op, c.value) for c in weakness.conditions] == [(0, "=", -1.0)]


def test_ties_count_as_satisfied():
    x0 = np.random.default_rng(0).uniform(0, 1, (50, 2))
    assert held(x0, np.full((50, 1), -5e-7)).weakness() is None


def test_words(signature):
    data, _ = boxed()
    data = HeldOut(("sign", "x", "v"), data.requirements, data.x0, data.rho, data.each)
    weakness = data.weakness()
    text = weakness.text(data, signature)
    assert "sign = light" in text
    assert "<= x <=" in text
    assert " m" in text
    assert "sign = 1" in region_text(weakness.conditions, data.names)


def test_file_round_trip(trained):
    data = load_held_out(trained)
    assert data.names[0] == "x"
    assert data.each.shape == (5000, 4)
    assert data.requirements[data.worst] == "stop_sign"


def test_what_is_no_held_out_set_is_none(tmp_path):
    run = RunDir(tmp_path)
    assert load_held_out(run) is None
    path = run.place(RunDir.HELD_OUT)
    path.write_bytes(b"no archive")
    assert load_held_out(run) is None
    meta = np.array(json.dumps({"names": ["a"], "requirements": ["r"]}))
    np.savez(path, x0=np.zeros((3, 2)), rho=np.zeros(3), requirements=np.zeros((3, 1)), meta=meta)
    assert load_held_out(run) is None
    np.savez(path, x0=np.array([{}], dtype=object), rho=np.zeros(1), requirements=np.zeros((1, 1)), meta=meta)
    assert load_held_out(run) is None


def test_picture_shows_every_start_of_the_region(trained, signature):
    data = load_held_out(trained)
    picture = draw_failures(data, signature)
    starts, margins = picture.figure.axes
    shown = sum(len(collection.get_offsets()) for collection in starts.collections)
    assert shown == int((data.x0[:, 2] == 0).sum())
    assert starts.get_xlabel() == "x [m]"
    assert "stop_sign" in margins.get_title(loc="left")
    assert margins.get_xlabel() == "robustness of the plan"
    told = draw_failures(data, signature, {"stop_sign": "s", "give_way": "m"}).figure.axes[1]
    assert told.get_xlabel() == "robustness of the plan [s]"
    assert picture.svg()


def test_nothing_failing_draws_nothing():
    assert draw_failures(held(np.zeros((10, 2)), np.ones((10, 1)))) is None


def test_constant_columns_draw():
    x0 = np.zeros((10, 1))
    each = np.ones((10, 1))
    each[0] = -np.inf
    assert draw_failures(held(x0, each)).svg()


def test_starts_without_a_known_plan_are_told_apart():
    data, failing = boxed()
    hopeless = failing & (data.x0[:, 1] > 3)
    told = replace(data, known=~hopeless)
    left, known = told.unsolved
    assert (left, known) == (failing.sum(), (failing & ~hopeless).sum())
    assert told.unsolved_text == (
        f"{left} of 4,000 starts; a satisfying plan is known for {known} of them, "
        f"for {left - known} none was found"
    )
    assert data.unsolved_text == f"{left} of 4,000 starts"
    lost = replace(data, known=np.zeros(len(data.x0), dtype=bool))
    assert lost.unsolved_text.endswith(" starts; no satisfying plan is known for any of them")
    solvable = replace(data, known=np.ones(len(data.x0), dtype=bool))
    assert solvable.unsolved_text.endswith("; a satisfying plan is known for each of them")
    (legend,) = [axes.get_legend() for axes in draw_failures(solvable).figure.axes if axes.get_legend()]
    assert not any("(0)" in text.get_text() for text in legend.get_texts())
    (legend,) = [axes.get_legend() for axes in draw_failures(told).figure.axes if axes.get_legend()]
    assert [text.get_text() for text in legend.get_texts()][1:] == [
        f"no plan is known ({hopeless.sum()})",
        f"r0 fails ({known})",
    ]
