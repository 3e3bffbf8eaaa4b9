"""Random formulas of the whole language and random traces, from a seed."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
from proof.language import (
    Atom,
    Choice,
    Constant,
    Edge,
    Formal,
    Formula,
    Frozen,
    Many,
    Meet,
    Not,
    Over,
    Pair,
    Row,
    Step,
    Use,
    Window,
    substituted,
)
from proof.levels import inside
from proof.whole import read_in

DT = Fraction(1, 10)
HORIZON = 6
"""Steps of `T`."""

MODES = {"idle": 0, "go": 1, "halt": 3}


@dataclass(frozen=True)
class Taste:
    """Choices of what may be drawn.

    Attributes:
        constants: `true` and `false`.
        off_grid: bounds between samples.
        absolute: intervals on the mission clock.
        windows: bounds that mention `T`.
        smooth: margins that have a gradient almost everywhere, and no jumps.
        plain: comparisons of x, y and z alone, written as every tool reads them.
        past: operators that look back.
        steps: `next`, `prev`, `rise`, `fall`.
        bools: choices between bools, which are numbers as well.
        depth: how deep operators nest.
    """

    constants: bool = True
    off_grid: bool = True
    absolute: bool = False
    windows: bool = False
    smooth: bool = False
    plain: bool = False
    past: bool = True
    steps: bool = True
    bools: bool = False
    depth: int = 4


class Drawing:
    """One formula after another from one source of randomness."""

    def __init__(self, rng: random.Random, taste: Taste) -> None:
        self.rng, self.taste = rng, taste
        self._uses: list[Use] = []
        self._held: list[str] = []
        self._frozen = 0

    def formula(self, depth: int | None = None) -> Formula:
        """A formula at most `depth` operators deep."""
        if depth is None:
            depth = self.rng.choice([d for d in (0, 1, 2, 2, 3, 3, 4, 5) if d <= self.taste.depth])
        if depth == 0:
            return self._leaf()
        return self.rng.choice(self._kinds())(depth)

    def _kinds(self) -> list[Callable[[int], Formula]]:
        kinds = [self._over] * 4 + [self._meet] * 4 + [self._many] * 2 + [self._pair, self._not]
        if self.taste.steps:
            kinds += [self._step, self._edge]
        if not self.taste.plain:
            kinds += [self._choice, self._freeze if self._held else self._use]
        if not self.taste.plain and len(self._held) < 2:
            kinds.append(self._freeze)
        return kinds

    def _below(self, depth: int) -> Formula:
        """An operand; one in three is shallow, so that formulas do not explode."""
        return self.formula(depth - 1 if self.rng.random() < 0.66 else self.rng.randrange(depth))

    # ------------------------------------------------------------ operators

    def _over(self, depth: int) -> Formula:
        ops = ["always", "eventually", *(["historically", "once"] if self.taste.past else [])]
        op = self.rng.choice(ops)
        return Over(op, self.window(op in ("always", "eventually")), self._below(depth))

    def _meet(self, depth: int) -> Formula:
        ops = ["until", "until", "release", "unless", *(["since", "since"] if self.taste.past else [])]
        op = self.rng.choice(ops)
        return Meet(op, self.window(op != "since"), self._below(depth), self._below(depth))

    def _many(self, depth: int) -> Formula:
        items = tuple(self._below(depth) for _ in range(self.rng.choice([2, 2, 3])))
        return Many(self.rng.choice(["and", "or"]), items)

    def _pair(self, depth: int) -> Formula:
        return Pair(self.rng.choice(["->", "->", "<->", "xor"]), self._below(depth), self._below(depth))

    def _not(self, depth: int) -> Formula:
        return Not(self._below(depth))

    def _step(self, depth: int) -> Formula:
        return Step(self.rng.choice([1, -1]), self._below(depth))

    def _edge(self, depth: int) -> Formula:
        return Edge(self.rng.choice(["rise", "fall"]), self._below(depth))

    def _choice(self, depth: int) -> Formula:
        if self.taste.bools and self.rng.random() < 0.5:
            return self._between_bools(depth)
        return Choice(self._below(depth), self._below(depth), self._below(depth))

    def _between_bools(self, depth: int) -> Formula:
        """A choice between bools, or between such choices."""
        if depth > 1 and self.rng.random() < 0.3:
            return Choice(self._below(depth), self._between_bools(depth - 1), self._bool())
        return Choice(self._below(depth), self._bool(), self._bool())

    def _bool(self) -> Formula:
        name = self.rng.choice(["flag", "lamp"])
        return Atom(name, lambda row: row[name] - 0.5, False)

    def _freeze(self, depth: int) -> Formula:
        """One or two numbers, if what is below reads them."""
        bindings = []
        for _ in range(self.rng.choice([1, 1, 2])):
            text, value = self._seen()
            bindings.append((f"kept{self._frozen}", text, value))
            self._frozen += 1
        names = [name for name, _, _ in bindings]
        self._held += names
        body = self._below(depth)
        self._held = [name for name in self._held if name not in names]
        read = read_in(body)
        kept = tuple(binding for binding in bindings if binding[0] in read)
        return Frozen(kept, body) if kept else body

    def _use(self, depth: int) -> Formula:
        """A `def`: a named part, an old one again, or one of two patterns with arguments."""
        kind = self.rng.randrange(4)
        if kind == 0 and self._uses:
            return self.rng.choice(self._uses)
        if kind <= 1:
            part = self._below(depth)
            use = Use(f"d{len(self._uses)}", (), (), part, part)
            self._uses.append(use)
            return use
        return self._pattern(depth)

    def _pattern(self, depth: int) -> Formula:
        p, q = Formal("p"), Formal("q")
        if self.rng.random() < 0.5:
            window = Window(Fraction(0), Fraction(3), False, False, "[0, c3]")
            name, formals, template = "response", ("p", "q"), Pair("->", p, Over("eventually", window, q))
        else:
            window = Window(Fraction(1), Fraction(2), False, False, "[c1, 2 * c1]")
            name, formals, template = "held", ("p",), Many("and", (p, Not(Over("once", window, Not(p)))))
        arguments = tuple(self._below(depth) for _ in formals)
        bound = dict(zip(formals, arguments, strict=True))
        return Use(name, formals, arguments, template, substituted(template, bound))

    # -------------------------------------------------------------- windows

    def window(self, future: bool) -> Window:
        """Bounds of all four kinds, on and off the grid, bounded or not, at least one sample wide."""
        absolute = self.taste.absolute and future and self.rng.random() < 0.4
        while True:
            kind = self.rng.random()
            if kind < 0.12 and not absolute:
                return Window(Fraction(0), None, False, False, "")
            lo, hi = self._bound(future), None if kind < 0.3 else self._bound(future)
            if hi is not None and hi[0] < lo[0]:
                lo, hi = hi, lo
            opened = (self.rng.random() < 0.25, self.rng.random() < 0.25)
            window = self._written(lo, hi, opened, future, absolute)
            if any(inside(window, k, outward=False) for k in range(40)):
                return window

    def _written(
        self,
        lo: tuple[Fraction, str],
        hi: tuple[Fraction, str] | None,
        opened: tuple[bool, bool],
        future: bool,
        absolute: bool,
    ) -> Window:
        end = self.rng.choice(["inf", "end"] if future else ["inf"]) if hi is None else hi[1]
        colon = not opened[0] and self.rng.random() < 0.1
        left, right = "(" if opened[0] else "[", ")" if opened[1] else "]"
        text = f"{left}{lo[1]}{' : ' if colon else ', '}{end}{right}"
        upper = None if hi is None else hi[0]
        return Window(lo[0], upper, opened[0], opened[1] and hi is not None, text, absolute)

    def _bound(self, future: bool) -> tuple[Fraction, str]:
        """A time in steps, and one of its spellings."""
        if self.taste.windows and future and self.rng.random() < 0.4:
            return self.rng.choice(
                [
                    (Fraction(HORIZON), "T"),
                    (Fraction(HORIZON, 2), "T / 2"),
                    (Fraction(HORIZON - 1), "T - 100 ms"),
                    (Fraction(HORIZON + 2), "T + 2 steps"),
                ]
            )
        k = self.rng.choice([0, 0, 1, 2, 3, 4, 5, 7, 9])
        if self.taste.off_grid and self.rng.random() < 0.15:
            hundredths = 10 * k + self.rng.choice([2, 5, 9])
            return Fraction(hundredths, 10), self.rng.choice(
                [f"{hundredths / 100} s", f"{10 * hundredths} ms"]
            )
        spellings = [f"{k / 10} s", f"{100 * k} ms", f"{k} steps", f"{k} * c1", f"{k} * dt"]
        if k == 0:
            spellings = ["0", "0 s", "0 steps"]
        if k == 3:
            spellings += ["c3", "c1 + 2 * dt", "3e5 us"]
        return Fraction(k), self.rng.choice(spellings)

    # ----------------------------------------------------------- predicates

    def _leaf(self) -> Formula:
        if self.taste.constants and self.rng.random() < 0.07:
            return Constant(self.rng.random() < 0.5)
        kinds = [self._linear] * 3
        if not self.taste.plain:
            kinds += [self._looking, self._linear, self._chain, self._range, self._function, self._quantified]
            kinds += [self._place] if self.taste.smooth else [self._whole, self._jumping, self._place]
        return self.rng.choice(kinds)()

    def _number(self) -> tuple[float, str]:
        value = self.rng.randint(-16, 16) / 8
        return value, f"({value})" if value < 0 else f"{value}"

    def _linear(self) -> Formula:
        first, second = self.rng.sample(["x", "y", "z"], 2)
        (a, a_text), (c, c_text) = self._number(), self._number()
        op = self.rng.choice([">", ">=", "<", "<="])
        sign = 1 if op in (">", ">=") else -1
        if self.rng.random() < 0.5:
            return Atom(f"{first} {op} {c_text}", lambda row: sign * (row[first] - c), op in "<>")
        text = f"{first} + {a_text} * {second} {op} {c_text}"
        return Atom(text, lambda row: sign * (row[first] + a * row[second] - c), op in "<>")

    def _seen(self) -> tuple[str, Callable[[Row], float]]:
        """A number of this sample or of another one, or one that is frozen."""
        name = self.rng.choice(["x", "y", "z"])
        if self._held and self.rng.random() < 0.5:
            name = self.rng.choice(self._held)
            return name, lambda row: row[name]
        options: list[tuple[str, Callable[[Row], float]]] = [
            (name, lambda row: row[name]),
            (f"next({name})", lambda row: row[f"{name}+1"]),
            (f"prev({name})", lambda row: row[f"{name}-1"]),
            (f"delta({name})", lambda row: row[name] - row[f"{name}-1"]),
            (f"shift({name}, 2 steps)", lambda row: row[f"{name}+2"]),
            (f"shift({name}, -2)", lambda row: row[f"{name}-2"]),
        ]
        return self.rng.choice(options)

    def _looking(self) -> Formula:
        """A comparison of numbers that may be those of other samples."""
        (left_text, left), (right_text, right) = self._seen(), self._seen()
        c, c_text = self._number()
        op = self.rng.choice([">", ">=", "<", "<="])
        sign = 1 if op in (">", ">=") else -1
        text = f"{left_text} {op} {right_text} + {c_text}"
        return Atom(text, lambda row: sign * (left(row) - (right(row) + c)), op in "<>")

    def _chain(self) -> Formula:
        """`a <= x < b`; a conjunction that is written as one comparison."""
        name = self.rng.choice(["x", "y", "z"])
        (a, a_text), (b, b_text) = self._number(), self._number()
        low = Atom("", lambda row: row[name] - a, False)
        high = Atom("", lambda row: b - row[name], True)
        return Many("and", (low, high), f"({a_text} <= {name} < {b_text})")

    def _range(self) -> Formula:
        name = self.rng.choice(["x", "y", "z"])
        a, b = sorted([self.rng.randint(-16, 16) / 8, self.rng.randint(-16, 16) / 8])
        negated = self.rng.random() < 0.3
        inner = Many("and", (Atom("", lambda r: r[name] - a, False), Atom("", lambda r: b - r[name], False)))
        text = f"({name} {'not in' if negated else 'in'} [{a}, {b}])"
        return Many("and", (Not(inner) if negated else inner,), text)

    def _quantified(self) -> Formula:
        (c, c_text), every = self._number(), self.rng.random() < 0.5
        items = tuple(Atom("", lambda row, i=i: row["q"][i] - c * i, True) for i in range(3))
        text = f"({'forall' if every else 'exists'} i in 0..2: q[i] > {c_text} * i)"
        return Many("and" if every else "or", items, text)

    def _function(self) -> Formula:
        c, c_text = self._number()
        options: list[tuple[str, Callable[[Row], float]]] = [
            (f"abs(x) < {c_text}", lambda row: c - abs(row["x"])),
            (f"min(x, y) > {c_text}", lambda row: min(row["x"], row["y"]) - c),
            (f"max(x, y, z) < {c_text}", lambda row: c - max(row["x"], row["y"], row["z"])),
            (f"x^2 - y * z > {c_text}", lambda row: row["x"] ** 2 - row["y"] * row["z"] - c),
            (f"norm(q - [x, 0, 1]) < {c_text}", lambda row: c - math.dist(row["q"], (row["x"], 0, 1))),
            (f"clip(x, -1, level) > {c_text} * y", lambda row: min(max(row["x"], -1), 0.5) - c * row["y"]),
            (f"exp(-x^2) > {c_text}", lambda row: math.exp(-(row["x"] ** 2)) - c),
            (f"dot(q, [1, 2, y]) > {c_text}", lambda row: row["q"] @ (1, 2, row["y"]) - c),
        ]
        text, margin = self.rng.choice(options)
        return Atom(text, margin, True)

    def _place(self) -> Formula:
        options: list[tuple[str, Callable[[Row], float]]] = [
            ("[x, y] in disc", lambda row: 1 - math.hypot(row["x"], row["y"])),
            ("[x, y] not in disc", lambda row: math.hypot(row["x"], row["y"]) - 1),
            ("[z, x] in block", lambda row: _in_block(row["z"], row["x"])),
            ("[x, y] in union(disc, block)", lambda row: _in_either(row["x"], row["y"])),
            ("[x, y] in intersect(block, complement(disc))", lambda row: _in_block_only(row["x"], row["y"])),
            ("[x, y] in dilate(block, level)", lambda row: _in_block(row["x"], row["y"]) + 0.5),
            ("sweep([x + 0.03, y - 0.07]) not in disc", lambda row: row["swept_disc"]),
            ("sweep([x + 0.03, y - 0.07]) not in block", lambda row: row["swept_block"]),
            (
                "sweep([x + 0.03, y - 0.07]) in disc",
                lambda row: min(1 - math.hypot(*end) for end in _ends(row)),
            ),
            ("sweep([x + 0.03, y - 0.07]) in block", lambda row: min(_in_block(*end) for end in _ends(row))),
        ]
        text, margin = self.rng.choice(options)
        return Atom(text, margin, "not in" in text)

    def _whole(self) -> Formula:
        """Whole numbers, truth values and enums: half a step of margin."""
        k, mode = self.rng.randint(-2, 2), self.rng.choice(list(MODES))
        options: list[tuple[str, Callable[[Row], float]]] = [
            ("flag", lambda row: row["flag"] - 0.5),
            (f"n >= {k}", lambda row: row["n"] - k + 0.5),
            (f"n < {k}", lambda row: k - row["n"] - 0.5),
            (f"n == {k}", lambda row: 0.5 - abs(row["n"] - k)),
            (f"n != {k}", lambda row: abs(row["n"] - k) - 0.5),
            (f"mode == {mode}", lambda row: 0.5 - abs(row["mode"] - MODES[mode])),
            (f"mode != {mode}", lambda row: abs(row["mode"] - MODES[mode]) - 0.5),
        ]
        text, margin = self.rng.choice(options)
        return Atom(text, margin, False)

    def _jumping(self) -> Formula:
        c, c_text = self._number()
        options: list[tuple[str, Callable[[Row], float]]] = [
            (f"x % 2 > {c_text}", lambda row: row["x"] - 2 * math.floor(row["x"] / 2) - c),
            (f"floor(y) > {c_text}", lambda row: math.floor(row["y"]) - c - (0.5 if c == int(c) else 0.0)),
            (f"x + ind(y > 0) > {c_text}", lambda row: row["x"] + (row["y"] > 0) - c),
            (
                f"(if y >= z then x else -x) > {c_text}",
                lambda row: (row["x"] if row["y"] >= row["z"] else -row["x"]) - c,
            ),
        ]
        text, margin = self.rng.choice(options)
        return Atom(text, margin, True)


def _in_block(x: float, y: float) -> float:
    """Signed distance to the box [-1, 1] x [-1/2, 1/2]."""
    across, along = abs(x) - 1, abs(y) - 0.5
    outside = math.hypot(max(across, 0), max(along, 0))
    return -outside if outside > 0 else -max(across, along)


def _ends(row: Row) -> tuple[tuple[float, float], tuple[float, float]]:
    """Start and end of a segment, off the grid of ties; at the last sample it is a point."""
    x, y = row["x"], row["y"]
    return (x + 0.03, y - 0.07), (row.get("x+1", x) + 0.03, row.get("y+1", y) - 0.07)


def _nearest(row: Row, distance: Callable[[float, float], float]) -> float:
    """The least of a convex function along the segment, by thirds."""
    (x, y), (a, b) = _ends(row)

    def at(s: float) -> float:
        return distance(x + s * (a - x), y + s * (b - y))

    low, high = 0.0, 1.0
    for _ in range(60):
        third = (high - low) / 3
        if at(low + third) <= at(high - third):
            high -= third
        else:
            low += third
    return min(at(low), at(0.0), at(1.0))


def _in_either(x: float, y: float) -> float:
    return max(1 - math.hypot(x, y), _in_block(x, y))


def _in_block_only(x: float, y: float) -> float:
    return min(_in_block(x, y), math.hypot(x, y) - 1)


def trace(rng: random.Random, *, longest: int = 18, generic: bool = False) -> dict[str, Any]:
    """Signals by name, (time,) or (time, 3): numbers with many ties, or `generic` ones without any."""
    source = np.random.default_rng(rng.getrandbits(64))
    samples = rng.randint(1, longest)

    def numbers(*shape: int) -> Any:
        coarse = source.integers(-20, 21, size=shape) / 8
        return coarse + source.uniform(-0.06, 0.06, size=shape) if generic else coarse

    return {
        **{name: numbers(samples) for name in "xyz"},
        "n": source.integers(-2, 3, size=samples).astype(float),
        "flag": source.integers(0, 2, size=samples).astype(float),
        "mode": source.choice(list(MODES.values()), size=samples).astype(float),
        "q": numbers(samples, 3),
        "lamp": source.integers(0, 2, size=samples).astype(float),
    }


def rows(signals: dict[str, Any]) -> list[dict[str, Any]]:
    """The same, sample by sample, each with the numbers of its neighbours that exist: `x+1`, `x-2`; and
    how far the segment from (x, y) to the next sample stays away from two places.
    """
    samples = len(signals["x"])
    found = [{name: values[t] for name, values in signals.items()} for t in range(samples)]
    for t, row in enumerate(found):
        for name, k in product("xyz", (-2, -1, 1, 2)):
            if 0 <= t + k < samples:
                row[f"{name}{k:+d}"] = signals[name][t + k]
        row["swept_disc"] = _nearest(row, lambda x, y: math.hypot(x, y) - 1)
        row["swept_block"] = _nearest(row, lambda x, y: -_in_block(x, y))
    return found
