"""A robot description with something to see: meshes where they are known, else rods from joint to joint."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from stlc.dynamics.robots.urdf import read_urdf, robot_of

ROD = 0.05  # m, radius
_UNIT_MASS = {"ixx": "1", "iyy": "1", "izz": "1", "ixy": "0", "ixz": "0", "iyz": "0"}


def dressed(urdf: Path, meshes: Mapping[str, str], folder: Path) -> Path:
    """`urdf` as it is where it has anything to see, else a copy in `folder` that has.

    Args:
        urdf: of the robot; kinematics are enough.
        meshes: link -> file among those that come with PyBullet; others get rods.
        folder: for the copy.

    Raises:
        OSError, ValueError: the file cannot be read, or is no robot description.
    """
    robot = robot_of(read_urdf(urdf))
    if robot.find("link/visual") is not None:
        return urdf
    ends = _ends(robot)
    for link in robot.findall("link"):
        name = link.get("name", "")
        _weigh(link)
        mesh = _mesh(meshes.get(name))
        if mesh is not None:
            geometry = ElementTree.SubElement(ElementTree.SubElement(link, "visual"), "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=str(mesh))
            continue
        for end in ends.get(name, ()):
            _rod(link, end)
    path = folder / "robot.urdf"
    ElementTree.ElementTree(robot).write(path, encoding="utf-8")
    return path


def _mesh(name: str | None) -> Path | None:
    if name is None:
        return None
    import pybullet_data

    path = Path(pybullet_data.getDataPath()) / name
    return path if path.is_file() else None


def _ends(robot: ElementTree.Element) -> dict[str, list[tuple[float, float, float]]]:
    """Link -> where its joints are, in metres from its own origin."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for joint in robot.findall("joint"):
        parent, origin = joint.find("parent"), joint.find("origin")
        words = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        x, y, z = (float(word) for word in words.split())
        if parent is not None:
            found.setdefault(parent.get("link", ""), []).append((x, y, z))
    return found


def _weigh(link: ElementTree.Element) -> None:
    """Without a mass PyBullet complains of every link."""
    if link.find("inertial") is None:
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "mass", value="1")
        ElementTree.SubElement(inertial, "inertia", attrib=_UNIT_MASS)


def _rod(link: ElementTree.Element, end: tuple[float, float, float]) -> None:
    """A rod from the link's origin to `end`, with a ball there."""
    length = math.hypot(*end)
    x, y, z = end
    if length > ROD / 2:
        turn = f"0 {math.acos(z / length):.9g} {math.atan2(y, x):.9g}"
        _visual(link, (x / 2, y / 2, z / 2), turn, "cylinder", radius=f"{ROD}", length=f"{length:.9g}")
    _visual(link, end, "0 0 0", "sphere", radius=f"{1.3 * ROD:.9g}")


def _visual(
    link: ElementTree.Element, place: tuple[float, float, float], turn: str, shape: str, **sides: str
) -> None:
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "origin", xyz=" ".join(f"{value:.9g}" for value in place), rpy=turn)
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), shape, attrib=sides)
