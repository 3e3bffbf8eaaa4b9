"""Signals of a trace over the robustness of its requirements."""

from dataclasses import replace

import numpy as np
import pytest

from stlc.signature import Column, Signature
from stlc.view.signals import Choice, Deciding, Marks, choose_traces, draw_signals, left_out, margin_limits


@pytest.fixture
def margins(recording):
    rho = np.random.default_rng(0).normal(1, 1, (2, recording.traces, recording.samples))
    rho[:, :, -25:] = np.nan
    rho[0, 7, 30] = -9.0
    return {"first": rho[0], "second": rho[1]}


@pytest.fixture
def choices(margins):
    return choose_traces(np.nanmin(np.stack(list(margins.values())), axis=(0, 2)))


def test_the_worst_and_the_median_are_chosen():
    worst, typical = choose_traces(np.array([3.0, -1.0, 2.0, np.nan, 5.0, 4.0]))
    assert worst.index == 1
    assert typical.index == 0
    assert worst.title == "worst: trace 1"


def test_the_trace_in_which_the_guard_acted_most_is_chosen():
    least = np.array([3.0, -1.0, 2.0])
    worst, guarded = choose_traces(least, acted=np.array([4, 0, 7]))
    assert (worst.index, guarded.index) == (1, 2)
    assert guarded.title == "guard acted most, 7 times: trace 2"
    (only,) = choose_traces(least, acted=np.array([0, 9, 1]))
    assert only.index == 1
    assert choose_traces(least, acted=np.zeros(3, dtype=int))[1].title == "typical: trace 2"


def test_traces_can_have_names():
    worst, typical = choose_traces(np.array([3.0, -1.0]), ["a", "b"])
    assert (worst.title, typical.title) == ("worst: b", "typical: a")


def test_one_trace_is_shown_once():
    (only,) = choose_traces(np.zeros(1))
    assert (only.index, only.title) == (0, "trace 0")


def panels(picture, column, columns):
    """Label -> axes of one column."""
    axes = picture.figure.axes
    labels = [a.get_ylabel() for a in axes[::columns]]
    return dict(zip(labels, axes[column::columns], strict=True))


def test_panels_show_signals_decisions_and_robustness(recording, margins, choices):
    picture = draw_signals(recording, margins, choices)
    shown = panels(picture, 0, 2)
    assert list(shown) == [
        *(
            "x [m]",
            "v [m/s]",
            "tau [s]",
            "dx [m]",
            "v_lead [m/s]",
            "sign",
            "yielding",
            "decision",
            "first",
            "second",
        )
    ]
    line = np.asarray(shown["v [m/s]"].lines[0].get_ydata())
    np.testing.assert_array_equal(line, recording.data["v"][7])
    rho = np.asarray(shown["first"].lines[1].get_ydata())
    np.testing.assert_array_equal(rho[:-25], margins["first"][7, :-25])
    bad = np.asarray(shown["first"].lines[2].get_ydata())
    assert bad[30] == -9.0
    assert np.nanmax(bad) < 0
    assert shown["first"].get_ylim()[0] < -9 < 0 < shown["first"].get_ylim()[1]
    assert picture.svg()


def test_rounding_does_not_set_the_scale_of_margins():
    assert margin_limits(np.array([-5.6e-17, 0.0, 0.4, 1.0]))[1] > 0.9
    low, high = margin_limits(np.array([-0.1, 0.0, 0.4, 9.0]))
    assert low < -0.1
    assert high < 0.5  # large margins are cut


def test_a_long_title_stands_within_its_panel(recording, margins):
    names = [f"trace {k} (seed 12, agent {k})" for k in range(recording.traces)]
    acted = np.arange(recording.traces)
    least = np.nanmin(np.stack(list(margins.values())), axis=(0, 2))
    figure = draw_signals(recording, margins, choose_traces(least, names, acted)).figure
    figure.draw_without_rendering()
    for axes in figure.axes[:2]:
        title = axes._left_title.get_window_extent()
        assert title.x1 <= figure.bbox.x1
        assert title.y1 <= figure.bbox.y1


def test_what_has_no_panel_is_named(recording):
    more = Signature((*recording.signature.columns, *(Column(f"z{k}") for k in range(7))))
    still = {f"z{k}": np.full_like(recording.data["x"], k) for k in range(7)}
    wide = replace(recording, signature=more, data={**recording.data, **still})
    assert left_out(recording) == []
    assert left_out(wide) == [f"z{k}" for k in range(7)]


def test_thresholds_and_deciding_values_are_marked_where_they_belong(recording, margins):
    x = recording.data["x"][3]
    near, far = float(x.mean()), float(x.max() + 100 * (np.ptp(x) + 1))
    marks = Marks({"x": (near, far)}, (Deciding("x", 3, 7, (4, 9)), Deciding("x", 5, 7, None)))
    figure = draw_signals(recording, margins, (Choice(3, "trace 3"),), marks=marks).figure
    (panel,) = (axes for axes in figure.axes if axes.get_ylabel().startswith("x"))
    dashed = [line.get_ydata()[0] for line in panel.lines if line.get_linestyle() == "--"]
    assert dashed == [near]  # the far one would flatten the signal
    (dot,) = (line for line in panel.lines if line.get_marker() == "o")
    assert (dot.get_xdata()[0], dot.get_ydata()[0]) == (recording.times[7], x[7])
    (legend,) = figure.legends
    assert {"threshold", "decides the violation", "its window"} <= {t.get_text() for t in legend.get_texts()}


def test_margins_are_labelled_with_their_units(recording, margins, choices):
    shown = panels(draw_signals(recording, margins, choices, {"first": "m"}), 0, 2)
    assert list(shown)[-2:] == ["first [m]", "second"]


def test_the_backup_is_marked_in_every_panel(recording, margins, choices):
    decision = np.zeros((recording.traces, recording.samples - 1), dtype=np.int8)
    decision[7, 10:13], decision[7, 40] = 1, 2
    trace = replace(recording, extras={"decision": decision})
    shown = panels(draw_signals(trace, margins, choices), 0, 2)
    marks = [patch.get_x() for patch in shown["x [m]"].patches]
    assert marks == pytest.approx([1.0, 4.0])
    widths = [patch.get_width() for patch in shown["x [m]"].patches]
    assert widths == pytest.approx([0.3, 0.1])


def test_a_jump_is_not_drawn_as_a_passage(recording, margins, choices):
    x = recording.data["x"][7]
    jumps = int((np.abs(np.diff(x)) > 9).sum())
    assert jumps
    shown = panels(draw_signals(recording, margins, choices), 0, 2)
    assert int(np.isnan(shown["x [m]"].lines[0].get_ydata()).sum()) == jumps


def test_labels_of_an_enum_are_written(recording, margins, choices):
    shown = panels(draw_signals(recording, margins, choices), 0, 2)
    words = {text.get_text() for text in shown["sign"].texts}
    assert words
    assert words <= {"stop", "light"}


def test_a_trace_without_decisions_has_no_strip(recording, margins, choices):
    bare = replace(recording, extras={})
    shown = panels(draw_signals(bare, margins, choices), 1, 2)
    assert "decision" not in shown
    assert not shown["x [m]"].patches


@pytest.mark.apart
def test_great_values_are_drawn(recording, margins, choices):
    data = {name: values.copy() for name, values in recording.data.items()}
    for values in data.values():
        values[:, :3] = 1.7e308, -1.7e308, 1e-300
    margins["first"][:, :3] = 1.7e308, -1.7e308, np.inf
    margins["second"][:] = 1.7e308
    assert draw_signals(replace(recording, data=data), margins, choices).svg().startswith("<svg")


@pytest.mark.apart
def test_robustness_that_is_nowhere_defined_still_draws(recording, choices):
    rho = np.full((recording.traces, recording.samples), np.nan)
    rho[0, :5] = np.inf
    assert draw_signals(recording, {"r": rho}, choices).svg()
