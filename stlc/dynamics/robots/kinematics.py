"""Forward kinematics: a chain of joints, unrolled into numbers of the IR.

Constants are folded, so a seven-joint arm needs the sines and cosines of its joints and some thirty products
and sums: the torch graph and the C kernel compute the same few operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import TypeAlias

import numpy as np

from stlc.compile.ir import nodes as ir
from stlc.dynamics.model.algebra import Assignments
from stlc.dynamics.robots.urdf import Doubles, Joint

Point: TypeAlias = tuple[ir.Num, ...]
NAME = "v{}"


def position(joints: Sequence[Joint]) -> ir.Body:
    """Position of the tip in the frame of the base, (3,) m, from the positions of the moving joints."""
    moving = [joint for joint in joints if joint.kind != "fixed"]
    formals = {joint.name: f"q{index}" for index, joint in enumerate(moving)}
    writer = Assignments()
    point: Point = (ir.Const(0.0),) * 3
    for joint in reversed(joints):
        if joint.kind == "revolute":
            point = _turned(joint.axis, point, ir.Signal(formals[joint.name]), writer)
        elif joint.kind == "prismatic":
            point = _pushed(joint.axis, point, ir.Signal(formals[joint.name]), writer)
        point = _affine(joint.rotation, joint.offset, point, writer)
    return ir.Body(tuple(formals.values()), tuple(writer.lets), point)


def _turned(axis: Doubles, point: Point, angle: ir.Num, writer: Assignments) -> Point:
    """A point rotated about an axis (Rodrigues)."""
    along = _linear(np.outer(axis, axis), point)
    across = tuple(writer.name(num, NAME) for num in _linear(np.eye(3) - np.outer(axis, axis), point))
    if all(num == ir.Const(0.0) for num in across):
        return point
    x, y, z = axis
    aside = _linear(np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), point)
    cosine, sine = (writer.name(ir.Op(name, (angle,)), NAME) for name in ("cos", "sin"))
    return tuple(
        writer.name(_sum(_sum(kept, _product(cosine, part)), _product(sine, turned)), NAME)
        for kept, part, turned in zip(along, across, aside, strict=True)
    )


def _pushed(axis: Doubles, point: Point, length: ir.Num, writer: Assignments) -> Point:
    """A point translated along an axis."""
    return tuple(
        writer.name(_sum(part, _product(ir.Const(float(share)), length)), NAME)
        for part, share in zip(point, axis, strict=True)
    )


def _affine(rotation: Doubles, offset: Doubles, point: Point, writer: Assignments) -> Point:
    """`rotation @ point + offset`."""
    return tuple(
        writer.name(_sum(part, ir.Const(float(shift))), NAME)
        for part, shift in zip(_linear(rotation, point), offset, strict=True)
    )


def _linear(matrix: Doubles, point: Point) -> Point:
    """`matrix @ point`, constants folded."""
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
            return ir.Op("sub", (left, taken))
        case ir.Op("neg", (taken,)), _:
            return ir.Op("sub", (right, taken))
        case _:
            return ir.Op("add", (left, right))


def _product(left: ir.Num, right: ir.Num) -> ir.Num:
    match left, right:
        case ir.Const(a), ir.Const(b):
            return ir.Const(a * b)
        case (ir.Const(0.0), _) | (_, ir.Const(0.0)):
            return ir.Const(0.0)
        case (ir.Const(1.0), kept) | (kept, ir.Const(1.0)):
            return kept
        case (ir.Const(-1.0), kept) | (kept, ir.Const(-1.0)):
            return kept.args[0] if isinstance(kept, ir.Op) and kept.name == "neg" else ir.Op("neg", (kept,))
        case _, ir.Op("neg", (kept,)):
            return ir.Op("neg", (_product(left, kept),))
        case _:
            return ir.Op("mul", (left, right))
