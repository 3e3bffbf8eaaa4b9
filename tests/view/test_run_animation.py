"""The animation of a run: by its world, else by its signals."""

import os

import numpy as np
import pytest
from PIL import Image

from stlc.view.run_animation import animate, animation_name, animation_of, current

WORLD = """
class Dots:
    def reset(self): ...
    def advance(self, x, action): ...
    def progress(self): return {}
    def units(self): return {}
    def snapshot(self): ...
    @staticmethod
    def draw(axes, scene, index):
        axes.plot(scene["x"][index], 0 * scene["x"][index], "o", color="#0072b2")
        axes.set(xlim=(0, 10), ylim=(-2, 2), aspect="equal")
"""


@pytest.fixture
def seen(deployed):
    """A run whose system names a world that was recorded."""
    system = (deployed.path / "system.yaml").read_text()
    lines = [line for line in system.splitlines() if "world:" not in line]
    lines.insert(lines.index("test:") + 1, '  world: "dots.py:Dots"')
    (deployed.path / "system.yaml").write_text("\n".join(lines) + "\n")
    (deployed.path / "dots.py").write_text(WORLD)
    frames = np.linspace(1, 9, 7)[:, None] + np.zeros(3)
    np.savez(deployed.path / "scene.npz", x=frames, decision=np.zeros((7, 3), dtype=np.int8))
    return deployed


def frame_count(path):
    with Image.open(path) as image:
        return image.n_frames


def test_a_world_draws_its_scene(seen):
    animation = animation_of(seen)
    assert animation.frames == 7
    assert animation.dt == pytest.approx(0.1)
    path = animate(seen)
    assert path.name == "traffic.gif"
    assert frame_count(path) == 7
    assert (seen.path / "scene.png").exists()


@pytest.mark.parametrize(
    "damage",
    ["no scene", "no world file", "a world that fails", "a drawing that fails", "a scene that is no archive"],
)
def test_without_a_world_signals_are_shown(seen, damage, recording):
    match damage:
        case "no scene":
            (seen.path / "scene.npz").unlink()
        case "no world file":
            (seen.path / "dots.py").unlink()
        case "a world that fails":
            (seen.path / "dots.py").write_text("raise RuntimeError('broken')\n")
        case "a drawing that fails":
            (seen.path / "dots.py").write_text(WORLD.replace('scene["x"]', 'scene["y"]'))
        case _:
            (seen.path / "scene.npz").write_bytes(b"nothing")
    assert animation_of(seen).frames == recording.samples


STAGED = """
    @staticmethod
    def stage(scene):
        raise RuntimeError("bodies are asked for")
"""


def test_robots_are_drawn_by_their_world_where_there_is_no_pybullet(seen, monkeypatch):
    (seen.path / "dots.py").write_text(WORLD + STAGED)
    monkeypatch.setattr("stlc.view.bullet.available", lambda: False)
    assert animation_of(seen).frames == 7


def test_a_run_without_a_deployment_has_no_film(trained):
    assert animation_of(trained) is None
    assert animate(trained) is None
    assert not list(trained.path.glob("*.gif"))


def test_an_animation_is_current_until_there_is_a_newer_recording(seen):
    assert not current(seen)
    path = animate(seen)
    assert current(seen)
    later = path.stat().st_mtime_ns + 2_000_000_000
    os.utime(seen.path / "scene.npz", ns=(later, later))
    assert not current(seen)


def test_a_hostile_name_stays_in_the_folder(seen):
    seen.update({"spec": "../../etc/passwd"})
    assert animation_name(seen) == "etc-passwd"
