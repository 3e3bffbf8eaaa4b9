"""Films: frames, time, size."""

import numpy as np
import pytest
from PIL import Image

from stlc.view.film import save_gif, save_still, scene_film, signal_film


def draw_dot(axes, scene, index):
    """A world of one dot that moves to the right on a field of 20 x 10."""
    axes.plot(scene["x"][index], 5, "o", color="#0072b2")
    axes.set(xlim=(0, 20), ylim=(0, 10), aspect="equal")
    axes.set_axis_off()


def frames_of(path):
    frames = []
    with Image.open(path) as image:
        for index in range(image.n_frames):
            image.seek(index)
            frames.append((np.asarray(image.convert("RGB")), image.info["duration"]))
    return frames


def test_a_scene_moves_in_real_time(tmp_path):
    film = scene_film({"x": np.linspace(1, 19, 12)}, draw_dot, 0.1, title="dot")
    assert film.frames == 12
    assert film.size[0] > film.size[1]
    frames = frames_of(save_gif(film, tmp_path / "a.gif"))
    assert len(frames) == 12
    assert {duration for _, duration in frames} == {100}
    places = [np.nonzero((image[:, :, 2] > 140) & (image[:, :, 0] < 60))[1].mean() for image, _ in frames]
    assert places == sorted(places)
    assert places[-1] - places[0] > 0.7 * frames[0][0].shape[1]


def test_many_instants_are_thinned_and_keep_their_pace(tmp_path):
    film = scene_film({"x": np.linspace(1, 19, 50)}, draw_dot, 0.1)
    frames = frames_of(save_gif(film, tmp_path / "a.gif", max_frames=10))
    assert len(frames) == 10
    assert {duration for _, duration in frames} == {500}


def test_a_large_film_is_made_smaller(tmp_path):
    def draw_noise(axes, scene, index):
        axes.imshow(scene["field"][index], cmap="gray")

    field = np.random.default_rng(0).random((4, 80, 80))
    film = scene_film({"field": field}, draw_noise, 0.1)
    path = save_gif(film, tmp_path / "a.gif", max_bytes=150_000)
    assert path.stat().st_size <= 150_000
    assert len(frames_of(path)) == 4


def test_signals_grow(recording, tmp_path):
    film = signal_film(recording, title="run")
    assert film.frames == recording.samples
    path = save_still(film, tmp_path / "still.png", at=1.0, dpi=40)
    with Image.open(path) as image:
        assert image.size[0] == pytest.approx(6.4 * 40, abs=1)
    frames = frames_of(save_gif(film, tmp_path / "a.gif", max_frames=3))
    first, last = frames[0][0].astype(int), frames[-1][0].astype(int)
    assert (last < 128).sum() > (first < 128).sum()
