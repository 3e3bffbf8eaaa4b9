"""Random planning tasks with circles in the plane, as in TeLoGraF (Meng & Fan 2025, arXiv 2504.03015).

The sizes of the circles, the time windows and the shapes of the formulas are those of TeLoGraF's generator
(https://github.com/mengyuest/TeLoGraF, commit e37bece, `code/generate_scene_v1.py`). There are four kinds of
task: reach (and possibly stay), nested `and`/`or`, sequences, and until. Each task has up to six obstacles. A
plan has 64 steps. As published, time windows that would extend beyond the last sample of the plan are cut
there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot, pi

from numpy.random import Generator, default_rng

STEPS = 64
ARENA, MARGIN, GAP = 5.0, 0.5, 1.05
SMALL, MIDDLE, LARGE = 0.5, 0.75, 1.5
TRIES = 1_000
OBSTACLES = (0.2, 0.15, 0.15, 0.15, 0.15, 0.1, 0.1)
KINDS = ("reach", "nested", "sequence", "until")
RATIOS = (1, 3, 2, 4)
"""Relative frequency of each kind in the published tests, `--type_ratios`."""
PATTERNS = (
    ("AB", "A"),
    ("AB", "BC", "A"),
    ("AB", "AC", "A"),
    ("BA", "CA", "B", "C"),
    ("AB", "BC", "CD", "A"),
    ("AB", "AC", "AD", "A"),
    ("AB", "BC", "BD", "A"),
    ("AB", "AC", "CD", "A"),
    ("AB", "CD", "A", "C"),
    ("BA", "CA", "DA", "B", "C", "D"),
    ("AB", "BC", "DE", "A", "D"),
    ("AB", "CE", "DE", "A", "C", "D"),
)
"""Shapes of until-tasks: `AB` means "not A until B", and `A` means "reach A"."""


@dataclass(frozen=True, slots=True)
class DrawnTask:
    """A random task.

    Attributes:
        kind: one of `KINDS`.
        text: text of the specification, which names no system. Its time windows are cut at the end of the
            plan.
        x0: initial state; for circles (x, y, heading, speed).
    """

    kind: str
    text: str
    x0: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Visit:
    """Visit of a circle: be inside it for `stay + 1` consecutive samples.

    The visit begins between `first` and `last` samples after the instant at which its formula is evaluated.
    """

    circle: int
    first: int
    last: int
    stay: int

    def then(self, rest: str = "") -> str:
        """Return the formula of this visit.

        If the formula `rest` is given, it must hold at the beginning of the visit.
        """
        inside = f"at_{self.circle}"
        held = f"always[0, {self.stay} steps] {inside}" if self.stay else inside
        follow = f"({held} and {rest})" if rest else held
        return f"eventually[{self.first} steps, {self.last} steps] {follow}"


def draw(seed: int, kind: str | None = None) -> DrawnTask:
    """Draw a task; if `kind` is None, the kind is drawn with the probabilities `RATIOS`."""
    return Draw(default_rng(seed)).task(kind)


class Draw:
    """Generator of one random task: a random number generator and the objects drawn so far.

    The objects are circles (x, y, radius).

    Attributes:
        patterns: possible shapes of a task of kind `until`, as in `PATTERNS`.
        most: greatest number of visits in a sequence.
    """

    patterns: tuple[tuple[str, ...], ...] = PATTERNS
    most = 4

    def __init__(self, random: Generator) -> None:
        self._random = random
        self._objects: list[tuple[float, ...]] = []

    def task(self, kind: str | None) -> DrawnTask:
        """Draw a task; if `kind` is None, the kind is drawn with the probabilities `RATIOS`."""
        shares = [each / sum(RATIOS) for each in RATIOS]
        kind = kind or KINDS[int(self._random.choice(len(KINDS), p=shares))]
        kinds: Mapping[str, Callable[[], str]] = {
            "reach": self._reach,
            "nested": self._nested,
            "sequence": self._sequence,
            "until": self._until,
        }
        goal = kinds[kind]()
        goals = len(self._objects)
        for _ in range(int(self._random.choice(len(OBSTACLES), p=OBSTACLES))):
            if self._obstacle() is None:
                break
        x0 = self._start()
        avoid = {
            f"avoid_{i}": f"always[0, {STEPS - 1} steps] not at_{i}" for i in range(goals, len(self._objects))
        }
        return DrawnTask(kind, self._spec({"goal": goal, **avoid}, goals), x0)

    # ------------------------------------------------------------------- kinds

    def _reach(self) -> str:
        return self._visit().then()

    def _nested(self) -> str:
        return self._branch(0, "and" if self._random.random() < 0.5 else "or")

    def _branch(self, depth: int, word: str) -> str:
        """Return a random formula that joins visits by nested `and` and `or`.

        `word` is the operator at this level, "and" or "or"; the levels below alternate between the two.
        `depth` is the number of levels above; there are at most three levels. In the shapes, `r` stands for a
        visit and `_` for a formula of the next level.
        """
        shapes = (
            ("rr", "rrr", "_r", "__"),
            ("rr",) if word == "and" else ("rr", "_r", "__"),
            ("rr",),
        )[depth]
        other = "or" if word == "and" else "and"
        shape = shapes[int(self._random.integers(len(shapes)))]
        return _joined(
            word, [self._visit().then() if leaf == "r" else self._branch(depth + 1, other) for leaf in shape]
        )

    def _sequence(self) -> str:
        """Return the formula of a random sequence of 2 to `most` visits.

        The time window of each visit counts from the beginning of the visit before it.
        """
        visits = [
            self._visit(int(self._random.integers(8)), int(self._random.integers(STEPS - 8, STEPS)))
            for _ in range(int(self._random.integers(2, self.most + 1)))
        ]
        text = ""
        for visit in reversed(visits):
            text = visit.then(text)
        return text

    def _until(self) -> str:
        pattern = self.patterns[int(self._random.integers(len(self.patterns)))]
        circles: dict[str, int] = {}
        parts = []
        for term in pattern:
            for name in term:
                if name not in circles:
                    circles[name] = self._goal()
            if len(term) == 2:
                parts.append(f"(not at_{circles[term[0]]}) until[0, end] at_{circles[term[1]]}")
            else:
                parts.append(_Visit(circles[term], 0, STEPS - 1, self._stay()).then())
        return _joined("and", parts)

    # ------------------------------------------------------------------- parts

    def _visit(self, first: int | None = None, stop: int | None = None) -> _Visit:
        """Draw a visit of a new circle.

        The visit begins at least `first` and less than `stop` samples from now. If either of the two is None,
        both are drawn at random.
        """
        circle = self._goal()
        if first is None or stop is None:
            first = int(self._random.integers(STEPS - 1))
            stop = int(self._random.integers(first + 1, STEPS))
        return _Visit(circle, first, stop - 1, self._stay())

    def _stay(self) -> int:
        return int(self._random.integers(3, 10)) - 1 if self._random.random() > 0.5 else 0

    def _goal(self) -> int:
        number = self._circle(SMALL, MIDDLE)
        assert number is not None
        return number

    def _obstacle(self) -> int | None:
        """Add a random obstacle and return its index; None if no free place was found."""
        return self._circle(MIDDLE, LARGE)

    def _circle(self, least: float, most: float) -> int | None:
        """Add a random circle away from the other circles, and return its index.

        The radius lies between `least` and `most`. The result is None if no free place was found.
        """
        for _ in range(TRIES):
            radius = float(self._random.uniform(least, most))
            limit = ARENA - 1.05 * radius
            x, y = (float(each) for each in self._random.uniform(-limit, limit, 2))
            if all(hypot(x - a, y - b) - r - radius >= GAP for a, b, r in self._objects):
                self._objects.append((x, y, radius))
                return len(self._objects) - 1
        return None

    def _start(self) -> tuple[float, ...]:
        """Draw an initial state (x, y, heading, speed) whose position is away from the circles.

        If no such position is found, the last position that was tried is returned.
        """
        for _ in range(TRIES):
            limit = ARENA - MARGIN
            x, y = (float(each) for each in self._random.uniform(-limit, limit, 2))
            if all(hypot(x - a, y - b) - r > GAP for a, b, r in self._objects):
                break
        return x, y, float(self._random.uniform(-pi, pi)), float(self._random.uniform(0, 1))

    def _spec(self, requirements: Mapping[str, str], goals: int) -> str:  # noqa: ARG002 - all are circles
        """Return the text of the specification, with the formulas `requirements` (name -> formula).

        The first `goals` objects are goals, and the others are obstacles.
        """
        lines = ["spec circles", "state signal x, y [m]"]
        for number, (x, y, r) in enumerate(self._objects):
            margin = f"({r:.4f} m)^2 - (x - ({x:.4f} m))^2 - (y - ({y:.4f} m))^2"
            lines.append(f"def at_{number} = {margin} >= 0 m^2")
        return "\n".join([*lines, *(f"require {name}: {text}" for name, text in requirements.items()), ""])


def _joined(word: str, parts: Sequence[str]) -> str:
    return f" {word} ".join(f"({each})" for each in parts)
