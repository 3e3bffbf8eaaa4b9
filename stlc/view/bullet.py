"""Drawing of robots as 3D bodies by PyBullet: as pictures without a display, or in PyBullet's window."""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeAlias
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from stlc.controller.sketch import DECIDED, NOTE, deciders
from stlc.controller.stage import Ball, Stage
from stlc.diagnostics import MissingError
from stlc.dynamics.declaration.kinematics import read_urdf, robot_of
from stlc.extras import not_installed
from stlc.view.scene import Scene

Mode: TypeAlias = Literal["picture", "window"]
Draw: TypeAlias = Callable[[Any, Scene, int], None]
Rgba: TypeAlias = tuple[float, float, float, float]

SIZE = 1216
"""Width of a picture in pixels."""
PITCH = 1.32
"""Distance between the bases of robots, as a multiple of the arm's reach."""
CLEAR = 0.6
"""Opacity of the balls in a picture."""
_AWAY, _TILT, _FIELD = 9.0, -16.0, 0.86  # camera: distance (reaches), tilt (degrees), half height (reaches)
_WHITE: Rgba = (1.0, 1.0, 1.0, 1.0)


def available() -> bool:
    """True if PyBullet is installed."""
    return find_spec("pybullet") is not None


def stage_drawing(stage: Stage) -> Draw:
    """Return a function `draw(axes, scene, index)` that renders the robots of a 3D scene side by side.

    Args:
        stage: joint angles of the robots, and the balls (goals and obstacles) around each of them.
    """
    renderer = Renderer(stage, "picture")

    def draw(axes: Any, scene: Scene, index: int) -> None:
        picture = renderer.picture(index, deciders(scene, index, stage.joints.shape[1]))
        height, width = picture.shape[:2]
        axes.imshow(picture, extent=(0, width, 0, height), interpolation="antialiased")
        for robot in range(stage.joints.shape[1]):
            across = width * (robot + 0.5) / stage.joints.shape[1]
            axes.text(across, 0.02 * height, f"arm {robot}", ha="center", size=7.5, color=NOTE)
        axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
        axes.set_axis_off()

    return draw


def show(stage: Stage, scene: Scene, dt: float) -> None:
    """Play a 3D scene in PyBullet's window, in real time, until it ends or the window is closed.

    Args:
        stage: joint angles of the robots, and the balls (goals and obstacles) around each of them.
        scene: name -> recorded array (frames, …). One of them gives the source of each decision: the policy,
            or a stage of the guard.
        dt: seconds between frames.

    Raises:
        MissingError: R301, PyBullet is not installed; R302, there is no display.
    """
    require_window()
    renderer = Renderer(stage, "window")
    try:
        for index in range(len(stage.joints)):
            begin = time.perf_counter()
            renderer.turn(index, deciders(scene, index, stage.joints.shape[1]))
            time.sleep(max(0.0, dt - (time.perf_counter() - begin)))
    except renderer.client.error:  # the user closed the window
        if renderer.open:
            raise
    finally:
        renderer.close()


def require_window() -> None:
    """Raise MissingError: R301 if PyBullet is not installed, R302 if there is no display."""
    if not available():
        raise not_installed("pybullet", need="a window needs")
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        advice = ("leave `--window` out: the animation shows the same, and needs no display",)
        raise MissingError.of("R302", "there is no display for a window", help=advice)


class Renderer:
    """PyBullet simulation of the robots of a 3D scene, in a row along x, each with its balls.

    The balls are goals and obstacles of a robot.
    """

    def __init__(self, stage: Stage, mode: Mode) -> None:
        with _silenced():
            import pybullet
            from pybullet_utils.bullet_client import BulletClient

            self.client: Any = BulletClient(pybullet.GUI if mode == "window" else pybullet.DIRECT)
            self.stage, self.clear = stage, CLEAR if mode == "window" else 1.0
            self.count = stage.joints.shape[1]
            self.places = PITCH * stage.reach * np.arange(self.count)[:, None] * np.array([1.0, 0.0, 0.0])
            if mode == "window":
                self.client.configureDebugVisualizer(self.client.COV_ENABLE_GUI, 0)
                self.client.configureDebugVisualizer(self.client.COV_ENABLE_RENDERING, 0)  # while robots load
                away = 0.5 * PITCH * self.stage.reach * max(self.count, 2)
                self.client.resetDebugVisualizerCamera(away, 10, -20, self._middle())
            self.robots = self._robots()
            self.discs = [self._disc(place) for place in self.places]
            self.balls = [[self._ball(ball) for _ in range(self.count)] for ball in stage.balls]
            self.client.configureDebugVisualizer(self.client.COV_ENABLE_RENDERING, 1)
        self.shown = np.full(self.count, -1)

    @property
    def open(self) -> bool:
        """True as long as the PyBullet window is open."""
        return bool(self.client.isConnected())

    def close(self) -> None:
        """Disconnect from PyBullet, which closes its window."""
        if self.open:
            with _silenced():
                self.client.disconnect()

    def turn(self, index: int, who: NDArray[np.int64]) -> None:
        """Show frame `index`.

        The colour of the disc under a robot depends on the source of its decision. `who`, (robots,), contains
        the sources: 0 is the policy, any other number a stage of the guard. If the guard made the decision,
        the robot itself gets the same colour. Otherwise it is white.
        """
        self.client.configureDebugVisualizer(self.client.COV_ENABLE_RENDERING, 0)  # until all is in place
        for robot, body in enumerate(self.robots):
            angles = self.stage.joints[index, robot, :, None].tolist()
            self.client.resetJointStatesMultiDof(body, self.movable, angles)
            if self.shown[robot] != who[robot]:
                color = _rgba(DECIDED[int(who[robot])])
                self.client.changeVisualShape(self.discs[robot], -1, rgbaColor=color)
                for link in self.links:
                    self.client.changeVisualShape(body, link, rgbaColor=color if who[robot] else _WHITE)
        for ball, bodies in zip(self.stage.balls, self.balls, strict=True):
            for robot, body in enumerate(bodies):
                self._put(body, self.places[robot] + ball.centre[index, robot])
        self.shown = who.copy()
        self.client.configureDebugVisualizer(self.client.COV_ENABLE_RENDERING, 1)

    def picture(self, index: int, who: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Render frame `index` as an RGB image (height, width, 3).

        `who`, (robots,), is the source of each robot's decision: 0 is the policy, any other number a stage of
        the guard. Transparent balls are blended by this method, not by PyBullet.
        """
        self.turn(index, who)
        whole = self._rendered()
        for body in (body for bodies in self.balls for body in bodies):
            self._put(body, np.array([0.0, 0.0, -1000.0]))
        return np.asarray(CLEAR * whole + (1 - CLEAR) * self._rendered()).astype(np.uint8)

    # --------------------------------------------------------------------- making

    def _robots(self) -> list[int]:
        with tempfile.TemporaryDirectory() as folder:
            path = str(with_visuals(self.stage.urdf, self.stage.meshes, Path(folder)))
            robots = [self.client.loadURDF(path, place.tolist(), useFixedBase=True) for place in self.places]
        joints = range(self.client.getNumJoints(robots[0]))
        self.movable = [j for j in joints if self.client.getJointInfo(robots[0], j)[2] in (0, 1)]
        self.links = [-1, *joints]
        return robots

    def _disc(self, place: NDArray[np.float64]) -> int:
        """Add the disc on which a robot stands, centred at `place` in metres; return its PyBullet index."""
        radius = 0.28 * self.stage.reach
        shape = self.client.createVisualShape(self.client.GEOM_CYLINDER, radius=radius, length=0.01)
        return int(self.client.createMultiBody(0, -1, shape, (place - (0, 0, 0.006)).tolist()))

    def _ball(self, ball: Ball) -> int:
        import pybullet_data

        round_one = str(Path(pybullet_data.getDataPath()) / "sphere_smooth.obj")
        shape = self.client.createVisualShape(
            self.client.GEOM_MESH,
            fileName=round_one,
            meshScale=[ball.radius] * 3,
            rgbaColor=_rgba(ball.color, self.clear),
        )
        return int(self.client.createMultiBody(0, -1, shape))

    def _put(self, body: int, place: NDArray[np.float64]) -> None:
        self.client.resetBasePositionAndOrientation(body, place.tolist(), (0, 0, 0, 1))

    # --------------------------------------------------------------------- seeing

    def _middle(self) -> list[float]:
        return [float(self.places[:, 0].mean()), 0.0, 0.5 * self.stage.reach]

    def _rendered(self) -> NDArray[np.float64]:
        reach = self.stage.reach
        wide, high = 0.5 * PITCH * reach * self.count, _FIELD * reach
        far = _AWAY * reach * max(self.count / 2, 1.0)
        view = self.client.computeViewMatrixFromYawPitchRoll(self._middle(), far, 0.0, _TILT, 0.0, 2)
        near = 0.5 * far
        sides = (-wide * near / far, wide * near / far, -high * near / far, high * near / far)
        lens = self.client.computeProjectionMatrix(*sides, near, 2 * far)
        height = round(SIZE * high / wide)
        _, _, pixels, _, _ = self.client.getCameraImage(
            SIZE,
            height,
            view,
            lens,
            shadow=0,
            lightDirection=(0.5, -0.8, 2.0),
            lightAmbientCoeff=0.62,
            lightDiffuseCoeff=0.42,
            lightSpecularCoeff=0.04,
            renderer=self.client.ER_TINY_RENDERER,
            flags=self.client.ER_NO_SEGMENTATION_MASK,
        )
        return np.reshape(np.asarray(pixels, dtype=np.float64), (height, SIZE, 4))[..., :3]


def _rgba(color: str, strength: float = 1.0) -> Rgba:
    red, green, blue = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue, strength


@contextmanager
def _silenced() -> Iterator[None]:
    """Silence PyBullet, whose C code prints to the standard output."""
    sys.stdout.flush()
    sys.stderr.flush()
    streams = [os.dup(number) for number in (1, 2)]
    try:
        with Path(os.devnull).open("wb") as nowhere:
            for number in (1, 2):
                os.dup2(nowhere.fileno(), number)
            yield
    finally:
        for number, saved in zip((1, 2), streams, strict=True):
            os.dup2(saved, number)
            os.close(saved)


# ---------------------------------------------------------------------- bodies


ROD = 0.05  # m, radius
_UNIT_MASS = {"ixx": "1", "iyy": "1", "izz": "1", "ixy": "0", "ixz": "0", "iyz": "0"}


def with_visuals(urdf: Path, meshes: Mapping[str, str], folder: Path) -> Path:
    """Return the path of a robot description with visual geometry.

    If the file `urdf` has visual geometry, its path is returned. Otherwise, a copy with added geometry is
    written, and the path of the copy is returned.

    Args:
        urdf: path of the robot description (URDF); it may contain the kinematics only.
        meshes: link -> mesh file of PyBullet; links without a mesh are drawn as rods.
        folder: folder for the copy.

    Raises:
        OSError, ValueError: the file cannot be read, or is not a robot description.
    """
    robot = robot_of(read_urdf(urdf))
    if robot.find("link/visual") is not None:
        return urdf
    ends = _ends(robot)
    for link in robot.findall("link"):
        name = link.get("name", "")
        if link.find("inertial") is None:  # PyBullet warns of links without a mass
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "mass", value="1")
            ElementTree.SubElement(inertial, "inertia", attrib=_UNIT_MASS)
        mesh = None
        if name in meshes:
            import pybullet_data

            mesh = Path(pybullet_data.getDataPath()) / meshes[name]
        if mesh is not None and mesh.is_file():
            geometry = ElementTree.SubElement(ElementTree.SubElement(link, "visual"), "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=str(mesh))
            continue
        for end in ends.get(name, ()):  # a rod from the link's origin, with a ball at its end
            length = math.hypot(*end)
            x, y, z = end
            if length > ROD / 2:
                turn = f"0 {math.acos(z / length):.9g} {math.atan2(y, x):.9g}"
                middle, size = (x / 2, y / 2, z / 2), f"{length:.9g}"
                _visual(link, middle, turn, "cylinder", radius=f"{ROD}", length=size)
            _visual(link, end, "0 0 0", "sphere", radius=f"{1.3 * ROD:.9g}")
    path = folder / "robot.urdf"
    ElementTree.ElementTree(robot).write(path, encoding="utf-8")
    return path


def _ends(robot: ElementTree.Element) -> dict[str, list[tuple[float, float, float]]]:
    """Positions of the joints at each link, in metres from the link's origin: link -> positions."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for joint in robot.findall("joint"):
        parent, origin = joint.find("parent"), joint.find("origin")
        words = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        x, y, z = (float(word) for word in words.split())
        if parent is not None:
            found.setdefault(parent.get("link", ""), []).append((x, y, z))
    return found


def _visual(
    link: ElementTree.Element, place: tuple[float, float, float], turn: str, shape: str, **sides: str
) -> None:
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "origin", xyz=" ".join(f"{value:.9g}" for value in place), rpy=turn)
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), shape, attrib=sides)
