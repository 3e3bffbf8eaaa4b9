"""The style of pictures: scheme-aware, deterministic, and without traces in matplotlib's settings."""

import base64
import xml.etree.ElementTree as ET

import matplotlib as mpl
import pytest
from PIL import Image

import stlc.view
from stlc.diagnostics import MissingError
from stlc.extras import installation
from stlc.view.style import BLUE, INK, ON_DARK, PAPER, Picture, new_figure, picture_style


def draw():
    with picture_style():
        figure = new_figure(3, 2)
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=BLUE)
        axes.set_title("title")
    return Picture(figure, "a line")


def test_settings_are_left_alone():
    before = dict(mpl.rcParams)
    draw().svg()
    assert dict(mpl.rcParams) == before


def test_inks_follow_the_scheme():
    svg = draw().svg()
    ET.fromstring(svg)
    assert "prefers-color-scheme:dark" in svg
    assert f"var(--c{BLUE[1:]})" in svg
    assert f"--c{INK[1:]}:{ON_DARK[INK]}" in svg
    assert f"background:var(--c{PAPER[1:]})" in svg  # a dark page may be read in a light scheme
    drawn = svg.split("</style>", 1)[1]
    assert not [ink for ink in ON_DARK if ink in drawn]


def test_the_same_figure_gives_the_same_text():
    assert draw().svg() == draw().svg()


def test_data_uri_holds_the_svg():
    picture = draw()
    head, _, body = picture.data_uri().partition(",")
    assert head == "data:image/svg+xml;base64"
    assert base64.b64decode(body).decode() == picture.svg()


def test_png_stands_on_white(tmp_path):
    path = draw().save_png(tmp_path / "a.png", dpi=50)
    with Image.open(path) as image:
        assert image.size == (150, 100)
        assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.png"]


def test_missing_package_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(stlc.view, "find_spec", lambda name: None if name == "matplotlib" else object())
    assert not stlc.view.available()
    with pytest.raises(MissingError) as caught:
        stlc.view.require_drawing()
    (finding,) = caught.value.diagnostics
    assert finding.code == "R301"
    assert finding.help == (installation("plot"),)
    assert "matplotlib" in finding.message
    assert "pillow" not in finding.message


def test_available_here():
    assert stlc.view.available()


def test_an_svg_is_xml_whatever_its_labels_hold():
    """Noncharacters and controls may stand in no XML, not even in a comment."""
    with picture_style():
        figure = new_figure(2, 1)
        figure.text(0, 0, "\x1b[31m\ufffe\uffff--> <b>&$x$")
    root = ET.fromstring(Picture(figure, "").svg())
    assert root.tag.endswith("svg")
