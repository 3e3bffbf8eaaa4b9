"""Training curves from the rows of a run."""

import numpy as np
import pytest

from stlc.view.curves import draw_curves


def test_nothing_measured_draws_nothing():
    assert draw_curves([]) is None
    assert draw_curves([{"step": 1, "seconds": 0.1, "loss": 1.0, "accuracy": None}]) is None


def test_curves_show_what_the_rows_say(trained):
    rows = trained.rows()
    picture = draw_curves(rows)
    accuracy, requirements, loss, rate = picture.figure.axes
    xs, ys = accuracy.lines[0].get_data()
    assert list(xs) == [row["seconds"] for row in rows]
    assert list(ys) == [row["accuracy"] for row in rows]
    known = [row["feasible"] for row in rows if row["feasible"] is not None]
    assert list(accuracy.lines[2].get_ydata()) == known
    labels = [text.get_text() for text in requirements.get_legend().get_texts()]
    assert [label.split()[0] for label in labels] == list(rows[-1]["requirements"])
    assert [float(label.split()[-1]) for label in labels] == pytest.approx(
        [rows[-1]["requirements"][name] for name in rows[-1]["requirements"]], abs=0.01
    )
    assert list(loss.lines[0].get_ydata()) == [row["loss"] for row in rows]
    assert f"{rows[-1]['accuracy']:.3f}" in picture.alt
    assert rate.get_ylim()[1] > 0


def test_curves_are_told_without_their_noise():
    rng = np.random.default_rng(0)
    rows = [{"seconds": k, "accuracy": 0.9 + rng.normal(0, 0.02)} for k in range(600)]
    accuracy, *_ = draw_curves(rows).figure.axes
    faint, strong = (np.asarray(line.get_ydata()) for line in accuracy.lines)
    assert np.std(strong) < 0.5 * np.std(faint)
    assert strong[-1] == pytest.approx(np.mean(faint[-11:]))
    (label,) = [text.get_text() for text in accuracy.get_legend().get_texts()]
    assert label == f"policy  {strong[-1]:.3f}"


def test_no_legend_covers_a_curve(trained):
    figure = draw_curves(trained.rows()).figure
    figure.draw_without_rendering()
    for axes in figure.axes[:2]:
        assert axes.get_legend().get_window_extent().y1 < axes.get_window_extent().y0


@pytest.mark.parametrize(
    "key",
    ["requirements", *(pytest.param(key, marks=pytest.mark.apart) for key in ("loss", "lr", "feasible"))],
)
def test_a_missing_column_is_left_out(trained, key):
    rows = [{name: value for name, value in row.items() if name != key} for row in trained.rows()]
    assert draw_curves(rows).svg()


def test_negative_and_zero_values_are_drawn():
    rows = [
        {"seconds": s, "accuracy": 0.0, "loss": -1.0 + s, "lr": 0.0, "requirements": {"a": 0.0}}
        for s in (0.0, 1.0)
    ]
    assert draw_curves(rows).svg()
