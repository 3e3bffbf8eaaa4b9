"""Animations in few colours: what is small and vivid keeps its own."""

import io

import numpy as np
from PIL import Image, ImageDraw

from stlc.controller.sketch import DECIDED
from stlc.view.gif import COLOURS, encoded, fitting
from stlc.view.style import GREEN, RED


def rgb(color):
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)])


def legends(count=3):
    """A large soft gradient, as renderers make them, and above it a dot in each colour of a legend."""
    shades = np.linspace(120, 250, 400 * 200).reshape(200, 400)
    ground = np.stack([shades, shades, shades + 5], axis=2).astype(np.uint8)
    pictures = []
    for _ in range(count):
        picture = Image.fromarray(ground)
        pen = ImageDraw.Draw(picture)
        for index, color in enumerate((*DECIDED, GREEN, RED)):
            pen.ellipse((10 + 20 * index, 4, 16 + 20 * index, 10), fill=color)
        pictures.append(picture)
    return pictures


def frame(data, index=0):
    with Image.open(io.BytesIO(data)) as image:
        image.seek(index)
        return np.asarray(image.convert("RGB")).astype(int)


def test_a_dot_of_the_legend_keeps_its_colour():
    shown = frame(encoded(legends(), 50))
    for index, color in enumerate((*DECIDED, GREEN, RED)):
        assert np.abs(shown[7, 13 + 20 * index] - rgb(color)).max() <= 8, color


def test_what_is_seen_at_the_end_alone_keeps_its_colour():
    pictures = legends(40)
    ImageDraw.Draw(pictures[-1]).rectangle((300, 100, 320, 110), fill="#7700ff")
    shown = frame(encoded(pictures, 50), 1)  # equal frames are stored once
    assert np.abs(shown[105, 310] - rgb("#7700ff")).max() <= 8


def test_few_colours_are_kept_as_they_are():
    picture = Image.new("RGB", (60, 40), "white")
    ImageDraw.Draw(picture).point((5, 5), fill=RED)
    data = encoded([picture], 50)
    assert frame(data)[5, 5].tolist() == rgb(RED).tolist()
    assert frame(data)[0, 0].tolist() == [255, 255, 255]


def test_there_are_no_more_colours_than_allowed_and_a_large_film_is_made_smaller():
    whole = encoded(legends(), 50)
    assert len(np.unique(frame(whole).reshape(-1, 3), axis=0)) <= COLOURS
    small = fitting(legends(), 50, len(whole) - 1)
    assert len(small) < len(whole)
    assert frame(small).shape[1] < 400
