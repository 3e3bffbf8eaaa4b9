"""Films: frames, time, size."""

import io

import numpy as np
import pytest
from PIL import Image, ImageDraw

from stlc.controller.sketch import DECIDED
from stlc.view.animation import COLOURS, encoded, fitting, save_animation, save_still
from stlc.view.scene import SceneOptions, scene_animation
from stlc.view.signals import signal_animation
from stlc.view.style import GREEN, RED


def draw_dot(axes, scene, index):
    """A world of one dot that moves to the right on a field of 20 x 10."""
    axes.plot(scene["x"][index], 5, "o", color="#0072b2")
    axes.set(xlim=(0, 20), ylim=(0, 10), aspect="equal")
    axes.set_axis_off()


def animation_of(scene, draw=draw_dot, dt=0.1):
    return scene_animation(scene, SceneOptions(draw, dt, "dot"))


def saved(animation, folder, **limits):
    path = folder / "a.gif"
    save_animation(animation, path, **limits)
    return path


def frames_of(path):
    frames = []
    with Image.open(path) as image:
        for index in range(image.n_frames):
            image.seek(index)
            frames.append((np.asarray(image.convert("RGB")), image.info["duration"]))
    return frames


def test_a_scene_moves_in_real_time(tmp_path):
    animation = animation_of({"x": np.linspace(1, 19, 12)})
    assert animation.frames == 12
    assert animation.size[0] > animation.size[1]
    frames = frames_of(saved(animation, tmp_path))
    assert len(frames) == 12
    assert {duration for _, duration in frames} == {100}
    scenes = [image[60:] for image, _ in frames]  # without the head
    places = [np.nonzero((image[:, :, 2] > 140) & (image[:, :, 0] < 60))[1].mean() for image in scenes]
    assert places == sorted(places)
    assert places[-1] - places[0] > 0.7 * frames[0][0].shape[1]


def test_many_instants_are_thinned_and_keep_their_pace(tmp_path):
    animation = animation_of({"x": np.linspace(1, 19, 50)})
    frames = frames_of(saved(animation, tmp_path, max_frames=10))
    assert len(frames) == 10
    assert {duration for _, duration in frames} == {500}


def test_a_large_film_is_made_smaller(tmp_path):
    def draw_noise(axes, scene, index):
        axes.imshow(scene["field"][index], cmap="gray")

    field = np.random.default_rng(0).random((4, 80, 80))
    animation = animation_of({"field": field}, draw_noise)
    path = saved(animation, tmp_path, max_bytes=150_000)
    assert path.stat().st_size <= 150_000
    assert len(frames_of(path)) == 4


def test_signals_grow(recording, tmp_path):
    animation = signal_animation(recording, title="run")
    assert animation.frames == recording.samples
    path = save_still(animation, tmp_path / "still.png", at=animation.frames - 1, dpi=40)
    with Image.open(path) as image:
        assert image.size[0] == pytest.approx(6.4 * 40, abs=1)
    frames = frames_of(saved(animation, tmp_path, max_frames=3))
    first, last = frames[0][0].astype(int), frames[-1][0].astype(int)
    assert (last < 128).sum() > (first < 128).sum()


def test_what_takes_long_is_shown_faster(tmp_path):
    animation = animation_of({"x": np.linspace(1, 19, 400)})
    assert animation.speed == 3
    frames = frames_of(saved(animation, tmp_path, max_frames=8))
    assert {duration for _, duration in frames} == {1660}  # 5 s, in hundredths


# ---------------------------------------------------------------------- test_gif


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
