"""Robot descriptions (URDF), and their forward kinematics as symbolic expressions.

A chain of joints is unrolled and constants are folded. A seven-joint arm then needs the sines and cosines of
its joints and some thirty products and sums; the torch graph and the C kernel compute the same operations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Literal, TypeAlias
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.assignments import Assignments
from stlc.files import File, read_regular

Doubles: TypeAlias = NDArray[np.float64]
Kind: TypeAlias = Literal["revolute", "prismatic", "fixed"]
_SNAP = 1e-9
"""Tolerance within which an entry of a rotation is rounded to an integer: files round pi / 2."""
_KINDS: Mapping[str, Kind] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
}


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint, in the frame of its parent link.

    Attributes:
        name: name in the robot description.
        kind: type of the joint, such as `revolute`.
        parent: link that it is attached to.
        offset: origin of the frame of the link that it moves, (3,), in metres.
        rotation: rotation matrix of this frame at joint position 0, (3, 3).
        axis: unit vector in this frame, (3,).
    """

    name: str
    kind: Kind
    parent: str
    offset: Doubles
    rotation: Doubles
    axis: Doubles


def chain(text: str, tip: str, base: str | None = None) -> tuple[Joint, ...]:
    """The joints from `base` (the root of the robot, if left out) to the link `tip`.

    Raises:
        ValueError: the text is not URDF, lacks the link, or has an unsupported joint.
    """
    joints = {joint.get("name", ""): joint for joint in robot_of(text).findall("joint")}
    above = {_link(joint, "child"): joint for joint in joints.values()}
    links = above.keys() | {_link(joint, "parent") for joint in joints.values()}
    for link in (tip, base):
        if link is not None and link not in links:
            raise ValueError(f"there is no link `{link}`; links: {', '.join(sorted(links))}")
    found: list[Joint] = []
    here = tip
    while here in above and here != base:
        if len(found) > len(joints):
            raise ValueError(f"the joints above `{tip}` form a ring")
        found.append(_joint(above[here]))
        here = found[-1].parent
    if base is not None and here != base:
        raise ValueError(f"`{base}` is not above `{tip}`")
    return tuple(reversed(found))


def read_urdf(path: Path) -> str:
    """Return the text of a URDF file. Raises OSError (also: it is too large), or ValueError if not UTF-8."""
    return read_regular(path, File.MAX_BYTES).decode("utf-8")


def robot_of(text: str) -> ElementTree.Element:
    """Return the root element of a robot description.

    Raises ValueError if the text is not URDF, or uses XML features (such as entities) that are refused.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("a robot description has no document type and no entities")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not XML: {error}") from error
    if root.tag != "robot":
        raise ValueError(f"its root is <{root.tag}>, not <robot>")
    return root


def _link(joint: ElementTree.Element, end: str) -> str:
    found = joint.find(end)
    name = None if found is None else found.get("link")
    if name is None:
        raise ValueError(f"the joint `{joint.get('name')}` has no <{end} link>")
    return name


def _joint(element: ElementTree.Element) -> Joint:
    name = element.get("name", "")
    written = element.get("type", "")
    if written not in _KINDS:
        raise ValueError(f"the joint `{name}` is {written or 'of no type'}; known: {', '.join(_KINDS)}")
    origin, axis = element.find("origin"), element.find("axis")
    kind = _KINDS[written]
    along = _triple(axis, "xyz", (1.0, 0.0, 0.0), name)
    length = float(np.linalg.norm(along))
    if kind != "fixed" and length < _SNAP:
        raise ValueError(f"the axis of the joint `{name}` is zero")
    return Joint(
        name=name,
        kind=kind,
        parent=_link(element, "parent"),
        offset=_triple(origin, "xyz", (0.0, 0.0, 0.0), name),
        rotation=_rotation(*_triple(origin, "rpy", (0.0, 0.0, 0.0), name)),
        axis=along / length if kind != "fixed" else along,
    )


def _triple(element: ElementTree.Element | None, key: str, default: tuple[float, ...], joint: str) -> Doubles:
    text = None if element is None else element.get(key)
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([math.nan])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"`{key}` of the joint `{joint}` is not three numbers: `{text}`")
    return values


def _rotation(roll: float, pitch: float, yaw: float) -> Doubles:
    """Return the rotation matrix Rz(yaw) Ry(pitch) Rx(roll), as in URDF, (3, 3).

    Entries close to an integer are rounded to it.
    """
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll, pitch, yaw))
    found = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    whole = np.rint(found)
    return np.where(np.abs(found - whole) < _SNAP, whole, found)


Point: TypeAlias = tuple[ir.Num, ...]
NAME = "v{}"


def position(joints: Sequence[Joint]) -> ir.Body:
    """Return expressions for the position of the tip in the frame of the base, (3,) in metres.

    The arguments of the expressions are the positions of the moving joints, in radians or metres.
    """
    moving = [joint for joint in joints if joint.kind != "fixed"]
    formals = {joint.name: f"q{index}" for index, joint in enumerate(moving)}
    writer = Assignments()
    point: Point = (ir.Const(0.0),) * 3
    for joint in reversed(joints):
        if joint.kind == "revolute":
            point = _turned(joint.axis, point, ir.Signal(formals[joint.name]), writer)
        elif joint.kind == "prismatic":
            length = ir.Signal(formals[joint.name])
            point = tuple(
                writer.name(_sum(part, _product(ir.Const(float(share)), length)), NAME)
                for part, share in zip(point, joint.axis, strict=True)
            )
        point = tuple(
            writer.name(_sum(part, ir.Const(float(shift))), NAME)
            for part, shift in zip(_linear(joint.rotation, point), joint.offset, strict=True)
        )
    return ir.Body(tuple(formals.values()), tuple(writer.lets), point)


def _turned(axis: Doubles, point: Point, angle: ir.Num, writer: Assignments) -> Point:
    """Rotate a point by `angle` (in radians) about an axis through the origin, by Rodrigues' formula.

    Coordinates are expressions. Intermediate results are appended to `writer`.
    """
    along = _linear(np.outer(axis, axis), point)
    across = tuple(writer.name(num, NAME) for num in _linear(np.eye(3) - np.outer(axis, axis), point))
    if all(num == ir.Const(0.0) for num in across):
        return point
    x, y, z = axis
    aside = _linear(np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), point)
    cosine, sine = (writer.name(angle.apply(name), NAME) for name in ("cos", "sin"))
    return tuple(
        writer.name(_sum(_sum(kept, _product(cosine, part)), _product(sine, turned)), NAME)
        for kept, part, turned in zip(along, across, aside, strict=True)
    )


def _linear(matrix: Doubles, point: Point) -> Point:
    """Return the point `matrix @ point`; constants are combined."""
    zero: ir.Num = ir.Const(0.0)
    return tuple(
        reduce(_sum, (_product(ir.Const(float(a)), part) for a, part in zip(row, point, strict=True)), zero)
        for row in matrix
    )


def _sum(left: ir.Num, right: ir.Num) -> ir.Num:
    match left, right:
        case ir.Const(a), ir.Const(b):
            return ir.Const(a + b)
        case (ir.Const(0.0), kept) | (kept, ir.Const(0.0)):
            return kept
        case _, ir.Op("neg", (taken,)):
            return left - taken
        case ir.Op("neg", (taken,)), _:
            return right - taken
        case _:
            return left + right


def _product(left: ir.Num, right: ir.Num) -> ir.Num:
    match left, right:
        case ir.Const(a), ir.Const(b):
            return ir.Const(a * b)
        case (ir.Const(0.0), _) | (_, ir.Const(0.0)):
            return ir.Const(0.0)
        case (ir.Const(1.0), kept) | (kept, ir.Const(1.0)):
            return kept
        case (ir.Const(-1.0), kept) | (kept, ir.Const(-1.0)):
            return kept.args[0] if isinstance(kept, ir.Op) and kept.name == "neg" else -kept
        case _, ir.Op("neg", (kept,)):
            return -_product(left, kept)
        case _:
            return left * right
