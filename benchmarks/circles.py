"""Random tasks over circles in the plane, in the manner of TeLoGraF (Meng & Fan 2025, arXiv 2504.03015).

Sizes, windows and shapes of formulas are those of its generator (https://github.com/mengyuest/TeLoGraF,
commit e37bece, `code/generate_scene_v1.py`): reach or stay, nested `and`/`or`, sequences, until, each with up
to six obstacles. The published windows are cut at the last sample of a plan of 64 steps. For planning, a stay
must end within the plan, and the windows of a sequence share its length, so that all fit. Such a plan
satisfies the published formula too, by which it is judged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import dist, hypot, pi

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
class CircleTask:
    """A drawn task.

    Attributes:
        kind: one of `KINDS`.
        planned: specification whose windows fit the plan, without a system.
        published: the same with the published windows, to be judged with windows cut at the last sample.
        x0: initial position, heading and speed.
    """

    kind: str
    planned: str
    published: str
    x0: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class _Text:
    """A formula with windows that fit, and as published."""

    planned: str
    published: str


@dataclass(frozen=True, slots=True)
class _Visit:
    """To be in a circle `stay + 1` samples long, beginning in a window of samples from now."""

    circle: int
    first: int
    last: int
    stay: int

    @property
    def alone(self) -> _Text:
        """As a formula at the first sample."""
        inside = f"at_{self.circle}"
        published = f"eventually[{self.first} steps, {self.last} steps] {self._held(inside)}"
        if not self.stay:
            return _Text(published, published)
        last = min(self.last, STEPS - self.stay)
        planned = f"eventually[{self.first} steps, {last} steps] {self._held(inside)}"
        if last < self.first:  # the end of the plan cuts every stay
            planned = f"eventually[{self.first} steps, {self.last} steps] always[0, end] {inside}"
        return _Text(planned, published)

    def then(self, rest: str, last: int) -> str:
        """Formula of this visit, to begin at `last` at the latest, and from its begin on of the `rest`."""
        follow = f" and {rest}" if rest else ""
        inside = self._held(f"at_{self.circle}")
        return f"eventually[{self.first} steps, {min(self.last, last)} steps] ({inside}{follow})"

    def _held(self, inside: str) -> str:
        return f"always[0, {self.stay} steps] {inside}" if self.stay else inside


def draw(seed: int, kind: str | None = None) -> CircleTask:
    """Draw a task; the kind by `RATIOS` if None."""
    return _Draw(default_rng(seed)).task(kind)


class _Draw:
    """One drawing: its random numbers and the circles so far."""

    def __init__(self, random: Generator) -> None:
        self._random = random
        self._circles: list[tuple[float, float, float]] = []

    def task(self, kind: str | None) -> CircleTask:
        shares = [each / sum(RATIOS) for each in RATIOS]
        kind = kind or KINDS[int(self._random.choice(len(KINDS), p=shares))]
        kinds: Mapping[str, Callable[[], _Text | list[_Visit]]] = {
            "reach": self._reach,
            "nested": self._nested,
            "sequence": self._sequence,
            "until": self._until,
        }
        drawn = kinds[kind]()
        goals = len(self._circles)
        for _ in range(int(self._random.choice(len(OBSTACLES), p=OBSTACLES))):
            if self._placed(MIDDLE, LARGE) is None:
                break
        start = self._start()
        goal = drawn if isinstance(drawn, _Text) else self._chain(drawn, start)
        avoid = {
            f"avoid_{i}": f"always[0, {STEPS - 1} steps] not at_{i}" for i in range(goals, len(self._circles))
        }
        heading, speed = float(self._random.uniform(-pi, pi)), float(self._random.uniform(0, 1))
        planned, published = ({"goal": text, **avoid} for text in (goal.planned, goal.published))
        return CircleTask(kind, self._spec(planned), self._spec(published), (*start, heading, speed))

    # ------------------------------------------------------------------- kinds

    def _reach(self) -> _Text:
        return self._visit().alone

    def _nested(self) -> _Text:
        return self._branch(0, "and" if self._random.random() < 0.5 else "or")

    def _branch(self, depth: int, word: str) -> _Text:
        """A tree of `and` and `or` whose leaves, marked r, are visits; deeper branches end sooner."""
        shapes = (
            ("rr", "rrr", "_r", "__"),
            ("rr",) if word == "and" else ("rr", "_r", "__"),
            ("rr",),
        )[depth]
        other = "or" if word == "and" else "and"
        shape = shapes[int(self._random.integers(len(shapes)))]
        return _joined(
            word, [self._visit().alone if leaf == "r" else self._branch(depth + 1, other) for leaf in shape]
        )

    def _sequence(self) -> list[_Visit]:
        """Two to four visits, each within its window after the one before began."""
        return [
            self._visit(int(self._random.integers(8)), int(self._random.integers(STEPS - 8, STEPS)))
            for _ in range(int(self._random.integers(2, 5)))
        ]

    def _until(self) -> _Text:
        pattern = PATTERNS[int(self._random.integers(len(PATTERNS)))]
        circles: dict[str, int] = {}
        parts = []
        for term in pattern:
            for name in term:
                if name not in circles:
                    circles[name] = self._goal()
            if len(term) == 2:
                text = f"(not at_{circles[term[0]]}) until[0, end] at_{circles[term[1]]}"
                parts.append(_Text(text, text))
            else:
                parts.append(_Visit(circles[term], 0, STEPS - 1, self._stay()).alone)
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
        number = self._placed(SMALL, MIDDLE)
        assert number is not None
        return number

    def _placed(self, least: float, most: float) -> int | None:
        """A new circle apart from the others; None where no place was found."""
        for _ in range(TRIES):
            radius = float(self._random.uniform(least, most))
            limit = ARENA - 1.05 * radius
            x, y = (float(each) for each in self._random.uniform(-limit, limit, 2))
            if all(hypot(x - a, y - b) - r - radius >= GAP for a, b, r in self._circles):
                self._circles.append((x, y, radius))
                return len(self._circles) - 1
        return None

    def _start(self) -> tuple[float, float]:
        """A position apart from the circles, the last one tried if there is none."""
        for _ in range(TRIES):
            limit = ARENA - MARGIN
            x, y = (float(each) for each in self._random.uniform(-limit, limit, 2))
            if all(hypot(x - a, y - b) - r > GAP for a, b, r in self._circles):
                break
        return x, y

    def _chain(self, visits: Sequence[_Visit], start: tuple[float, float]) -> _Text:
        """Visits in sequence; for planning, each window has a share of the plan, by stays and distances."""
        places = [start, *(self._circles[visit.circle][:2] for visit in visits)]
        stays = [0, *(visit.stay for visit in visits)]
        needs = [stay + 2 * dist(a, b) for stay, a, b in zip(stays, places, places[1:], strict=False)]
        left = STEPS - stays[-1] - sum(visit.first for visit in visits)
        published = planned = ""
        for visit, need in zip(reversed(visits), reversed(needs), strict=True):
            published = visit.then(published, visit.last)
            planned = visit.then(planned, visit.first + int(left * need / sum(needs)))
        return _Text(planned, published)

    def _spec(self, requirements: Mapping[str, str]) -> str:
        lines = ["spec circles", "state signal x, y [m]"]
        for number, (x, y, r) in enumerate(self._circles):
            margin = f"({r:.4f} m)^2 - (x - ({x:.4f} m))^2 - (y - ({y:.4f} m))^2"
            lines.append(f"def at_{number} = {margin} >= 0 m^2")
        return "\n".join([*lines, *(f"require {name}: {text}" for name, text in requirements.items()), ""])


def _joined(word: str, parts: Sequence[_Text]) -> _Text:
    joint = f" {word} "
    return _Text(
        joint.join(f"({each.planned})" for each in parts), joint.join(f"({each.published})" for each in parts)
    )
