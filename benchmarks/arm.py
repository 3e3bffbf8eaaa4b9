"""Random planning tasks for a robot arm among objects on a table, as in TeLoGraF (Meng & Fan 2025).

The sizes of the objects, the time windows and the shapes of the formulas are those of TeLoGraF's generator
(https://github.com/mengyuest/TeLoGraF, commit e37bece, `code/generate_panda_scene.py`). A plan has 64 steps.
Time windows that would extend beyond the end of the plan are cut there. A goal is a ball above a box on the
table. The arm must reach the goal with the hand pointing down. The flange must avoid the obstacles, which are
larger balls.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from math import dist, sqrt
from typing import TypeAlias

import numpy as np
from numpy.random import Generator, default_rng

from benchmarks.circles import PATTERNS, STEPS, TRIES, Draw, DrawnTask
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.kinematics import chain, position, read_urdf
from stlc.files import File

Point: TypeAlias = tuple[float, ...]

START = (0.0, 0.0, 0.0, -2.0, 0.0, 107.0 / 180.0 * np.pi, 0.0)
"""Angles of the joints: the middle of their ranges, but -2 rad at the elbow."""
TABLE = ((0.0, 0.9), (-0.75, 0.75))
HEIGHT = 0.02
"""Height of the table above the foot of the arm."""
EDGE, INNER = 0.05, 0.2
"""Distance (m) of all objects from the table's edge; extra distance of goals that are not alternatives."""
BOXES, BALLS = (0.03, 0.05), (0.05, 0.1)
"""Half the widths of goals and of obstacles."""
GAP, GAP_ARM = 0.01, 0.3
ABOVE, HIGHEST = 0.1, 0.5
"""Height of the flange above a goal; greatest height of an obstacle above the table (m)."""
HAND, UPRIGHT = 0.107, 0.9
"""Length of the hand's axis (m); least cosine of its angle with the vertical."""
LINKS = tuple(f"panda_link{i}" for i in range(9))
BETWEEN = 5
"""Number of points between two links that are treated as parts of the arm."""
PART = tuple(PATTERNS[i] for i in (0, 1, 2, 3, 8))


def draw_arm(seed: int, kind: str | None = None) -> DrawnTask:
    """Draw a task of the arm; if `kind` is None, the kind is drawn with the probabilities `RATIOS`."""
    return _ArmDraw(default_rng(seed)).task(kind)


class _ArmDraw(Draw):
    """Generator of one random task of the arm; an object is a tuple (x, y, z, half of its width)."""

    patterns = PART
    most = 3

    def __init__(self, random: Generator) -> None:
        super().__init__(random)
        self._margin = INNER

    def _reach(self) -> str:
        first = int(self._random.integers(STEPS // 2, STEPS - 1))
        return self._visit(first, int(self._random.integers(first + 1, STEPS))).then()

    def _branch(self, depth: int, word: str) -> str:
        before, self._margin = self._margin, 0.0 if word == "or" else INNER
        text = super()._branch(depth, word)
        self._margin = before
        return text

    def _goal(self) -> int:
        number = self._object(BOXES, self._margin)
        assert number is not None
        return number

    def _obstacle(self) -> int | None:
        return self._object(BALLS, 0.0, HIGHEST)

    def _object(self, sizes: tuple[float, float], margin: float, highest: float = 0.0) -> int | None:
        """Add a random object away from the other objects and from the arm; return its index.

        The object is a cube. The result is None if no free place was found.

        Args:
            sizes: least and greatest half-width of the object.
            margin: distance to the edge of the table, in addition to `EDGE`.
            highest: greatest height above the table. If it is not 0, half of the objects are above the table.
        """
        for _ in range(TRIES):
            size = float(self._random.uniform(*sizes))
            ends = [(low + margin + EDGE + size, high - margin - EDGE - size) for low, high in TABLE]
            x, y = (float(self._random.uniform(*each)) for each in ends)
            z = HEIGHT + size
            if highest and self._random.random() < 0.5:
                z += float(self._random.uniform(0.0, highest))
            gaps = [dist((x, y, z), each[:3]) - sqrt(3.0) * (each[3] + size) for each in self._objects]
            near = min(dist((x, y, z), each) for each in _arm()) - sqrt(3.0) * size
            if min(gaps, default=GAP) >= GAP and near >= GAP_ARM:
                self._objects.append((x, y, z, size))
                return len(self._objects) - 1
        return None

    def _start(self) -> Point:
        return START

    def _spec(self, requirements: Mapping[str, str], goals: int) -> str:
        lines = [
            "spec arm",
            "extern fn flange(q: real[7]) -> real[3] [m]",
            "extern fn wrist(q: real[7]) -> real[3] [m]",
            "state signal q : real[7] [rad]",
            f"def down = (wrist(q)[2] - flange(q)[2]) / ({HAND} m) >= {UPRIGHT}",
        ]
        for number, (x, y, z, size) in enumerate(self._objects):
            goal = number < goals
            up, radius = z + ABOVE * goal, size if goal else sqrt(3.0) * size
            away = f"norm(flange(q) - [{x:.4f} m, {y:.4f} m, {up:.4f} m])"
            margin = f"(({radius:.4f} m)^2 - {away}^2) / ({radius:.4f} m)^2"
            lines.append(f"def at_{number} = {margin} >= 0" + (" and down" if goal else ""))
        return "\n".join([*lines, *(f"require {name}: {text}" for name, text in requirements.items()), ""])


@cache
def _arm() -> tuple[Point, ...]:
    """Points along the links of the arm in its initial position, as tuples (x, y, z)."""
    text = read_urdf(File("examples/panda.yaml").system().with_name("panda.urdf"))
    places = np.array([_position(text, link) for link in LINKS])
    shares = np.arange(BETWEEN + 1)[:, None, None] / (BETWEEN + 1)
    points = ((1.0 - shares) * places[:-1] + shares * places[1:]).reshape(-1, 3)
    return tuple(map(tuple, [*points.tolist(), places[-1].tolist()]))


def _position(text: str, link: str) -> list[float]:
    if link == LINKS[0]:
        return [0.0, 0.0, 0.0]
    body = position(chain(text, link))
    args = tuple(ir.Signal(name) for name in body.formals)
    program = ArrayProgram({str(i): ir.Extern("f", args, i, body) for i in range(3)})
    angles = {name: np.array([angle]) for name, angle in zip(body.formals, START, strict=False)}
    found = program(angles)
    return [float(np.ravel(found[str(i)])[0]) for i in range(3)]
