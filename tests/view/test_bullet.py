"""Robots as bodies: descriptions with visuals, rendered pictures, no window without a display."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from stlc.controller.stage import Ball, Stage
from stlc.diagnostics import MissingError
from stlc.view import bullet
from stlc.view.bullet import with_visuals

PANDA = Path(__file__).parents[2] / "examples/panda.urdf"
needs_pybullet = pytest.mark.skipif(not bullet.available(), reason="PyBullet is not installed")


def stage(robots=2, frames=3, **more):
    joints = np.zeros((frames, robots, 7))
    joints[..., 3] = -1.5
    joints[1:, 0, 0] = 1.2
    goals = np.tile([0.4, -0.3, 0.5], (frames, robots, 1))
    goals[2] = (-0.5, 0.0, 0.9)
    return Stage(PANDA, joints, (Ball(goals, 0.1, "#009e73"),), 0.95, **more)


def test_bare_links_get_rods_along_their_joints(tmp_path):
    robot = ElementTree.parse(with_visuals(PANDA, {}, tmp_path)).getroot()
    shapes = {link.get("name"): link.findall("visual/geometry/*") for link in robot.findall("link")}
    assert [shape.tag for shape in shapes["panda_link0"]] == ["cylinder", "sphere"]
    assert float(shapes["panda_link0"][0].get("length")) == pytest.approx(0.333)
    assert [shape.tag for shape in shapes["panda_link1"]] == ["sphere"]  # the next joint is in the same place
    assert shapes["panda_link8"] == []


def test_a_rod_points_to_its_joint(tmp_path):
    robot = ElementTree.parse(with_visuals(PANDA, {}, tmp_path)).getroot()
    link = next(link for link in robot.findall("link") if link.get("name") == "panda_link4")
    origin = link.find("visual/origin")
    middle, (_, tilt, turn) = (np.array(origin.get(key).split(), dtype=float) for key in ("xyz", "rpy"))
    along = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    np.testing.assert_allclose(along * np.hypot(0.0825, 0.384), 2 * middle, atol=1e-6)
    np.testing.assert_allclose(2 * middle, (-0.0825, 0.384, 0), atol=1e-6)


def test_a_description_with_something_to_see_stays(tmp_path):
    path = tmp_path / "seen.urdf"
    shape = "<visual><geometry><sphere radius='1'/></geometry></visual>"
    path.write_text(f"<robot name='a'><link name='b'>{shape}</link></robot>")
    assert with_visuals(path, {}, tmp_path) == path


@needs_pybullet
def test_a_picture_shows_bodies_balls_and_who_decided(capfd):
    renderer = bullet.Renderer(stage(), "picture")
    still, moved, elsewhere = (renderer.picture(index, np.array([0, 1])) for index in range(3))
    assert capfd.readouterr().out == ""  # PyBullet's own talk stays away from results
    height, width = still.shape[:2]
    assert (width, still.shape[2]) == (bullet.SIZE, 3)
    colour = still.astype(int)
    tinted = (colour[..., 0] > colour[..., 2] + 90) & (colour[..., 1] > colour[..., 2] + 40)
    orange = [tinted[:, : width // 2].sum(), tinted[:, width // 2 :].sum()]
    assert orange[1] > 500 > 5 > orange[0]
    changed = (still != moved).any(2).nonzero()[1]
    assert len(changed) > 300
    assert changed.max() < width // 2
    green = [np.nonzero((p[..., 1].astype(int) - p[..., 0] > 40)[: height // 2]) for p in (moved, elsewhere)]
    assert len(green[1][0]) > len(green[0][0])


@needs_pybullet
def test_a_stage_is_drawn_into_axes():
    axes = pytest.importorskip("matplotlib.figure").Figure().add_subplot()
    bullet.stage_drawing(stage(robots=1))(axes, {"decision": np.zeros((3, 1), dtype=np.int8)}, 1)
    assert len(axes.images) == 1
    assert axes.get_xlim() == (0, bullet.SIZE)


def test_without_a_display_there_is_no_window(monkeypatch):
    monkeypatch.setattr(bullet, "available", lambda: True)
    monkeypatch.setattr(bullet.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(MissingError, match="R302"):
        bullet.require_window()


def test_without_pybullet_there_is_no_window(monkeypatch):
    monkeypatch.setattr(bullet, "available", lambda: False)
    with pytest.raises(MissingError, match="R301"):
        bullet.require_window()
