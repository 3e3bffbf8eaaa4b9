"""Random tasks over circles in the plane, in the manner of TeLoGraF (Meng & Fan 2025, arXiv 2504.03015).

Sizes, windows and shapes of formulas are those of its generator (https://github.com/mengyuest/TeLoGraF,
commit e37bece, `code/generate_scene_v1.py`): reach or stay, nested `and`/`or`, sequences, until, each with up
to six obstacles. As published, windows are cut at the last sample of a plan of 64 steps.
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
"""Share of each kind in the published tests, `--type_ratios`."""
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
"""Until-tasks: `AB` is not A until B, `A` is to reach A."""


@dataclass(frozen=True, slots=True)
class DrawnTask:
    """A drawn task.

    Attributes:
        kind: one of `KINDS`.
        text: specification, without a system; its windows are cut at the end of the plan.
        x0: initial state; for circles position, heading and speed.
    """

    kind: str
    text: str
    x0: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Visit:
    """To be in a circle `stay + 1` samples long, beginning in a window of samples from now."""

    circle: int
    first: int
    last: int
    stay: int

    def then(self, rest: str = "") -> str:
        """Formula of this visit, and from its begin on of the `rest`."""
        inside = f"at_{self.circle}"
        held = f"always[0, {self.stay} steps] {inside}" if self.stay else inside
        follow = f"({held} and {rest})" if rest else held
        return f"eventually[{self.first} steps, {self.last} steps] {follow}"


def draw(seed: int, kind: str | None = None) -> DrawnTask:
    """Draw a task; the kind by `RATIOS` if None."""
    return Draw(default_rng(seed)).task(kind)


class Draw:
    """One drawing: its random numbers and the objects so far, here circles (x, y, radius).

    Attributes:
        patterns: until-tasks, as in `PATTERNS`.
        most: greatest number of visits in a sequence.
    """

    patterns: tuple[tuple[str, ...], ...] = PATTERNS
    most = 4

    def __init__(self, random: Generator) -> None:
        self._random = random
        self._objects: list[tuple[float, ...]] = []

    def task(self, kind: str | None) -> DrawnTask:
        """Draw a task; the kind by `RATIOS` if None."""
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
        """A tree of `and` and `or` whose leaves, marked r, are visits; deeper branches end sooner."""
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
        """Two to four visits, each within its window after the one before began."""
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
        """A visit of a new circle, its window drawn if not given."""
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
        """A new obstacle; None where no place was found."""
        return self._circle(MIDDLE, LARGE)

    def _circle(self, least: float, most: float) -> int | None:
        """A new circle apart from the others; None where no place was found."""
        for _ in range(TRIES):
            radius = float(self._random.uniform(least, most))
            limit = ARENA - 1.05 * radius
            x, y = (float(each) for each in self._random.uniform(-limit, limit, 2))
            if all(hypot(x - a, y - b) - r - radius >= GAP for a, b, r in self._objects):
                self._objects.append((x, y, radius))
                return len(self._objects) - 1
        return None

    def _start(self) -> tuple[float, ...]:
        """A position apart from the circles, the last one tried if there is none, heading and speed."""
        for _ in range(TRIES):
            limit = ARENA - MARGIN
            x, y = (float(each) for each in self._random.uniform(-limit, limit, 2))
            if all(hypot(x - a, y - b) - r > GAP for a, b, r in self._objects):
                break
        return x, y, float(self._random.uniform(-pi, pi)), float(self._random.uniform(0, 1))

    def _spec(self, requirements: Mapping[str, str], goals: int) -> str:  # noqa: ARG002 - all are circles
        """The specification; the first `goals` objects are goals, the others obstacles."""
        lines = ["spec circles", "state signal x, y [m]"]
        for number, (x, y, r) in enumerate(self._objects):
            margin = f"({r:.4f} m)^2 - (x - ({x:.4f} m))^2 - (y - ({y:.4f} m))^2"
            lines.append(f"def at_{number} = {margin} >= 0 m^2")
        return "\n".join([*lines, *(f"require {name}: {text}" for name, text in requirements.items()), ""])


def _joined(word: str, parts: Sequence[str]) -> str:
    return f" {word} ".join(f"({each})" for each in parts)
