"""Random tasks over circles in the plane, in the manner of TeLoGraF (Meng & Fan, ICML 2025, arXiv 2504.03015).

Sizes, windows and shapes of formulas are those of its generator (https://github.com/mengyuest/TeLoGraF, commit
e37bece, `code/generate_scene_v1.py`): reach or stay, nested `and`/`or`, sequences, until, each with up to six
obstacles. A plan has 64 steps; there, windows are cut at its last sample. Here a stay must end within the plan,
and the successor in a sequence may come at any later time, so that every window fits; plans are then judged by
the published formula with its windows cut.
"""

from __future__ import annotations

from collections.abc import Sequence
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

    def map(self, template: str) -> _Text:
        return _Text(template.format(self.planned), template.format(self.published))


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
        begin, end = self.first + self.stay, min(self.last + self.stay, STEPS)
        if begin > STEPS:  # the end of the plan cuts every stay
            planned = f"eventually[{self.first} steps, {self.last} steps] always[0, end] {inside}"
        else:
            planned = f"eventually[{begin} steps, {end} steps] historically[0, {self.stay} steps] {inside}"
        return _Text(planned, published)

    def then(self, rest: _Text, since: _Visit | None) -> _Text:
        """With what follows it, as a formula at the end of the visit `since`, at first the first sample."""
        inside = f"at_{self.circle}"
        published = f"eventually[{self.first} steps, {self.last} steps] ({self._held(inside)} and {rest.published})"
        begin, end = self.first + self.stay, f"{min(self.last + self.stay, STEPS)} steps"
        if since is not None:
            begin, end = max(self.first - since.stay, 1) + self.stay, "end"
        held = f"historically[0, {self.stay} steps] {inside}" if self.stay else inside
        return _Text(f"eventually[{begin} steps, {end}] ({held} and {rest.planned})", published)

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
        goal = {"reach": self._reach, "nested": self._nested, "sequence": self._sequence, "until": self._until}
        parts = [("goal", goal[kind]())]
        goals = len(self._circles)
        for _ in range(int(self._random.choice(len(OBSTACLES), p=OBSTACLES))):
            if self._placed(MIDDLE, LARGE) is None:
                break
        avoid = f"always[0, {STEPS - 1} steps] not at_{{}}"
        parts += [
            (f"avoid_{i}", _Text(avoid.format(i), avoid.format(i))) for i in range(goals, len(self._circles))
        ]
        start = self._start()
        return CircleTask(
            kind,
            self._spec((name, text.planned) for name, text in parts),
            self._spec((name, text.published) for name, text in parts),
            (*start, float(self._random.uniform(-pi, pi)), float(self._random.uniform(0, 1))),
        )

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
        parts = []
        for leaf in shapes[int(self._random.integers(len(shapes)))]:
            parts.append(self._visit().alone if leaf == "r" else self._branch(depth + 1, other))
        return _joined(word, parts)

    def _sequence(self) -> _Text:
        """Two to four visits, each within its window after the one before began."""
        visits = [
            self._visit(int(self._random.integers(8)), int(self._random.integers(STEPS - 8, STEPS)))
            for _ in range(int(self._random.integers(2, 5)))
        ]
        told: _Text | None = None
        for number in reversed(range(len(visits))):
            rest = told or _Text("true", "true")
            told = visits[number].then(rest, visits[number - 1] if number else None)
        assert told is not None
        return told

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

    def _spec(self, parts: Sequence[tuple[str, str]]) -> str:
        lines = ["spec circles", "state signal x, y [m]"]
        for number, (x, y, r) in enumerate(self._circles):
            margin = f"({r:.4f} m)^2 - (x - ({x:.4f} m))^2 - (y - ({y:.4f} m))^2"
            lines.append(f"def at_{number} = {margin} >= 0 m^2")
        return "\n".join([*lines, *(f"require {name}: {text}" for name, text in parts), ""])


def _joined(word: str, parts: Sequence[_Text]) -> _Text:
    joint = f" {word} "
    return _Text(
        joint.join(f"({each.planned})" for each in parts), joint.join(f"({each.published})" for each in parts)
    )
