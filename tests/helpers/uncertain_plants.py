"""Random system files with parameters in every place that the format allows, and the same with other numbers.

A plant with other numbers is read from the text of the file in which the numbers are replaced, so that it
shares no code with factors of numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stlc.dynamics.load import parse_system
from stlc.dynamics.scenario import under
from stlc.dynamics.system import System
from stlc.source import Source

SPEC = """\
signal x
signal y
@safety
require below: always[0, T] x < {top}
@safety
require calm: always[0, T] abs(y) + x < {sum}
require back: eventually[0, T] (y < {low} and x > -2)
"""


@dataclass
class _Sections:
    """Entries of the sections of a file, as text."""

    const: list[str] = field(default_factory=list)
    state: list[str] = field(default_factory=list)
    table: list[str] = field(default_factory=list)
    held: list[str] = field(default_factory=list)
    delay: list[str] = field(default_factory=list)
    define: list[str] = field(default_factory=list)
    jump: list[str] = field(default_factory=list)
    drawn: list[str] = field(default_factory=list)
    x: list[str] = field(default_factory=list)
    y: list[str] = field(default_factory=list)
    controls: list[str] = field(default_factory=list)
    step: str = "0.1 s"


def _timer(s: _Sections, p: str, keys: str) -> None:
    s.state.append(f"t_{p}: {{unit: s, timer: up, {keys.replace('P', p)}}}")
    s.drawn.append(f't_{p}: "0.1 s * uniform(0, 1)"')
    s.y.append(f"0.5 * t_{p} / (1 s)")


def _table(s: _Sections, p: str, keys: str, term: str) -> None:
    s.table.append(f"tab_{p}: {{{keys.replace('P', p)}}}")
    s.x.append(term.replace("P", p))


def _held(s: _Sections, p: str, keys: str) -> None:
    s.held.append(f"h_{p}: {{{keys.replace('P', p)}}}")
    s.y.append(f"h_{p}")


def _delay(s: _Sections, p: str, keys: str) -> None:
    s.delay.append(f"d_{p}: {{{keys.replace('P', p)}}}")
    s.x.append(f"0.5 * d_{p}")


def _term(text: str) -> Callable[[_Sections, str], None]:
    return lambda s, p: s.x.append(text.replace("P", p))


def _jump(text: str) -> Callable[[_Sections, str], None]:
    return lambda s, p: s.jump.append(f"{{{text.replace('P', p)}}}")


def _mode(s: _Sections, p: str) -> None:
    s.state.append(f"m_{p}: {{enum: [low, high]}}")
    s.drawn.append(f"m_{p}: low")
    s.jump.append(f"{{name: m_{p}, guard: y > 0.6 * {p}, reset: {{m_{p}: high}}}}")
    s.x.append(f"(if m_{p} == high then 0.3 else 0)")


def _defined(s: _Sections, p: str) -> None:
    s.define.append(f"part_{p}: {p} * y")
    s.x.append(f"0.3 * part_{p}")


def _derived(s: _Sections, p: str) -> None:
    s.const.append(f"{p}_more: 2 * {p} ^ 2")
    s.y.append(f"0.2 * {p}_more * x")


_ROWS = "values: [[0.1, P, 0.4], [0.2, 0.3, -P]]"

CARRIED: Mapping[str, Callable[[_Sections, str], None]] = {
    "flow": _term("-P * x"),
    "product": _term("P * x * y"),
    "function": _term("0.5 * sin(P * y)"),
    "condition": _term("(if x > 0.5 * P then 0.3 else -0.2)"),
    "definition": _defined,
    "derived constant": _derived,
    "guard": _jump("name: g_P, guard: x > P, reset: {y: y - 0.3}"),
    "once": _jump("name: o_P, guard: x > 0.5 * P, reset: {y: y - 0.3}, once: true"),
    "reset": _jump('name: r_P, guard: y > 0.5, reset: {x: "0.5 * P * x"}'),
    "enum": _mode,
    "table": lambda s, p: _table(
        s, p, "of: [z], at: [-2, 0, 1, 3], values: [-0.4, P, 2 * P, 0.7]", "0.3 * tab_P(x)"
    ),
    "table of two": lambda s, p: _table(
        s,
        p,
        "of: [z, w], at: [[-1, 1], [-1, 0, 2]], values: [[0.1, P, 0.4], [0.2, 0.3, -P]], extrapolate: hold",
        "tab_P(x, y)",
    ),
    "held": lambda s, p: _held(s, p, 'value: "-P * x"'),
    "held condition": lambda s, p: _held(s, p, 'value: "if x > 0.4 * P then 0.2 else -0.1"'),
    "integrator": lambda s, p: _held(
        s, p, 'value: "clip(prev(h_P) + 0.3 * P * x, -1, 1)", before: 0, every: 2 steps'
    ),
    "before": lambda s, p: _held(s, p, 'value: "0.5 * prev(h_P) + 0.1 * x", before: P'),
    "delay": lambda s, p: _delay(s, p, 'of: "P * y", by: 2 steps'),
    "before a delay": lambda s, p: _delay(s, p, "of: y, by: 3 steps, before: P"),
    "varying delay": lambda s, p: _delay(s, p, 'of: y, by: "0.2 s * P", at_most: 5 steps'),
    "timer": lambda s, p: _timer(s, p, 'reset_when: "t_P > 0.3 s * P"'),
    "run": lambda s, p: _timer(s, p, "run: x < 0.5 * P, reset_when: x > 2"),
    "value of a timer": lambda s, p: _timer(s, p, 'reset_when: "t_P > 0.3 s", to: "0.2 s * P"'),
}
"""Place of a parameter -> what adds it there; `P` is the parameter."""


def _limited(s: _Sections, p: str) -> None:
    s.state.append(f"c: {{range: [-{p}, {p}], clamp: true}}")
    s.drawn.append("c: 0")
    s.y.append("c")


REFUSED: Mapping[str, Callable[[_Sections, str], None]] = {
    "init": lambda s, p: s.drawn.append(f'z: "{p} * uniform(0, 1)"'),
    "time step": lambda s, p: setattr(s, "step", f"0.1 s * {p}"),
    "clamp": _limited,
    "control": lambda s, p: s.controls.append(f"w: {{range: [-{p}, {p}]}}"),
    "points": lambda s, p: _table(s, p, "of: [z], at: [-2, P, 4], values: [0, 1, 2]", "0.1 * tab_P(x)"),
    "period": lambda s, p: _held(s, p, f"value: x, every: 0.2 s * {p}"),
    "fixed delay": lambda s, p: _delay(s, p, f"of: x, by: 0.2 s * {p}"),
    "longest delay": lambda s, p: _delay(s, p, f'of: x, by: "0.2 s", at_most: 0.2 s * {p}'),
}
"""Place of a parameter to which its error is not carried -> what adds it there."""

LITERALS = ("-0.3001 * x", "0.2003 * y / 1.5", "0.4007 * y * ind(x > 0)")
"""Terms with literals in the arithmetic."""


@dataclass(frozen=True)
class UncertainPlant:
    """Random system file.

    Attributes:
        text: the file.
        spec: a specification of its states.
        values: parameter or literal -> value.
        places: parameter -> its place.
        size: relative error of the numbers.
    """

    text: str
    spec: str
    values: Mapping[str, float]
    places: Mapping[str, str]
    size: float

    def system(self) -> System:
        """The system with the errors of its scenario."""
        return System(under(parse_system(Source("plant.yaml", self.text), Path("plant.yaml")), "off"))

    def rebuilt(self, factors: Mapping[str, float]) -> System:
        """The system of the text in which numbers are replaced by themselves times `factors`."""
        text = self.text
        for name, factor in factors.items():
            value = self.values[name]
            if name in self.places:
                text, count = re.subn(rf"(?m)^  {name}: .*$", f"  {name}: {float(value * factor)!r}", text)
            else:
                text, count = re.subn(re.escape(name), repr(float(value * factor)), text)
            assert count == 1, name
        return System(parse_system(Source("rebuilt.yaml", text), Path("rebuilt.yaml")))


def uncertain_plant(seed: int, *, listed: bool, refused: str | None = None) -> UncertainPlant:
    """Return a random plant.

    Args:
        seed: seed of the draws.
        listed: whether the file lists its parameters as uncertain; otherwise it has literals, too.
        refused: place of `REFUSED` in which one of the parameters stands.
    """
    rng = np.random.default_rng(seed)
    sections = _Sections()
    kinds = list(rng.choice(list(CARRIED), rng.integers(2, 5), replace=False))
    values, places = {}, {}
    for index, kind in enumerate([*kinds, *([refused] if refused else [])]):
        name = f"k{index}"
        values[name] = 1.0 if kind in REFUSED else float(np.round(rng.uniform(0.3, 1.2), 3))
        places[name] = str(kind)
        ({**CARRIED, **REFUSED})[kind](sections, name)
    for literal in () if listed else rng.choice(LITERALS, 2, replace=False):
        sections.y.append(str(literal))
        number = re.search(r"0\.\d+", str(literal))
        assert number is not None
        values[number[0]] = float(number[0])
    size = float(rng.choice([0.01, 0.05, 0.1, 0.2]))
    names = list(places)
    text = _written(sections, values, names, listed=listed, size=size, rng=rng)
    top, total, low = (float(np.round(each, 2)) for each in rng.uniform([0.5, 1, -0.5], [2, 3, 0.5]))
    spec = SPEC.format(top=top, sum=total, low=low)
    return UncertainPlant(text, spec, values, places, size)


def _written(
    s: _Sections,
    values: Mapping[str, float],
    names: list[str],
    *,
    listed: bool,
    size: float,
    rng: np.random.Generator,
) -> str:
    integrator = rng.choice(["euler", "heun", "rk4"])
    substeps = rng.integers(1, 3)
    drawn = {"x": '"uniform(-0.5, 0.5)"', "y": '"uniform(-0.5, 0.5)"', "z": "0"}
    drawn |= dict(each.split(": ", 1) for each in s.drawn)
    lines = [
        "stlc: 1",
        "name: plant",
        f"time: {{dt: {s.step}, horizon: 6 steps, integrator: {integrator}, substeps: {substeps}}}",
        "const:",
        *(f"  {name}: {values[name]!r}" for name in names),
        *(f"  {each}" for each in s.const),
        "state:",
        *("  x: {range: [-4, 4]}", "  y: {range: [-4, 4]}", "  z: {range: [-4, 4]}"),
        *(f"  {each}" for each in s.state),
        "control:",
        *("  u: {range: [-1, 1]}", *(f"  {each}" for each in s.controls)),
    ]
    for title, entries in (("table", s.table), ("held", s.held), ("delay", s.delay), ("def", s.define)):
        lines += [f"{title}:", *(f"  {each}" for each in entries)] if entries else []
    lines += [
        "flow:",
        f'  x: "{" + ".join(["0.8 * y + u", *s.x])}"',
        f'  y: "{" + ".join(["-0.5 * x + 0.3 * u", *s.y])}"',
    ]
    lines += ["jump:", *(f"  - {each}" for each in s.jump)] if s.jump else []
    lines += [
        "init:",
        "  mixture:",
        "    - draw:",
        *(f"        {name}: {value}" for name, value in drawn.items()),
    ]
    lines += [f"test: {{uncertain: [{', '.join(names)}]}}"] if listed else []
    lines += [f"scenario: {{off: {{errors: {{parameters: {size}}}}}}}"]
    return "\n".join(lines) + "\n"
