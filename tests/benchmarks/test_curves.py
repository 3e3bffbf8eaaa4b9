"""Curves of benchmarks: a panel each, a curve a training, the known feasible share as a line."""

from benchmarks.curves import Curve, Panel, draw_benchmarks

CURVE = Curve("guided", (1.0, 2.0), (0.5, 0.9), (3.0, 0.95))


def test_nothing_is_drawn_of_nothing():
    assert draw_benchmarks([]) is None
    assert draw_benchmarks([Panel("traffic", (), 0.97)]) is None


def test_panels_curves_and_known_feasible_shares():
    other = Curve("gradient", (), (), (3.0, 0.8))
    panels = [Panel("traffic", (CURVE, CURVE, other), 0.971), Panel("empty", (), None)]
    panels += [Panel(f"p{i}", (CURVE,), None) for i in range(3)]
    picture = draw_benchmarks(panels)
    axes = [each for each in picture.figure.axes if each.get_visible()]
    assert [each.get_title(loc="left") for each in axes] == ["traffic", "p0", "p1", "p2"]
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["guided", "gradient"]
    assert [text.get_text() for text in axes[0].texts] == ["known feasible 0.971"]
    assert not axes[1].texts
    assert picture.alt.startswith("Plan accuracy over training time; the best at the end: traffic 0.950, p0")
    assert picture.svg().startswith("<svg")
