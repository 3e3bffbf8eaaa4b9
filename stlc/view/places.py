"""The places that a specification names: where `[x, y] in R` holds, and when that matters.

Nothing here knows shapes. A place is the signed distance that the language gives to `in`, evaluated over a
grid of the plane: circles, polygons and unions are seen alike, and as the monitor judges them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import typed
from stlc.compile.ir.traverse import operands
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import StlcError
from stlc.grammar import ast
from stlc.grammar.children import descendants
from stlc.monitor.verdict import Monitor
from stlc.signature import Signature
from stlc.source import Span
from stlc.trace import Trace

Role = Literal["reach", "avoid", "mixed"]
Window: TypeAlias = tuple[float, float]

GRID = 240
"""Points along each axis at which a place is evaluated."""
ROOM = 0.06
"""Of the plane's size, left free around what there is to see."""
TITLE = 26
"""Letters of a place's name in a picture."""


@dataclass(frozen=True, slots=True)
class Use:
    """One occurrence of a place in a requirement.

    Attributes:
        requirement: its name.
        negative: under an odd number of negations.
        visit: being there at some time is enough.
        window: seconds from the start of the trace in which it matters; None where it always does.
    """

    requirement: str
    negative: bool
    visit: bool = False
    window: Window | None = None


@dataclass(frozen=True, slots=True)
class Place:
    """A region of the plane.

    Attributes:
        name: as declared, or its text.
        uses: where the specification speaks of it.
        monitor: judges whether a point is in it.
    """

    name: str
    uses: tuple[Use, ...]
    monitor: Monitor

    @property
    def title(self) -> str:
        """The name, cut where it is a text that would cover the picture."""
        return self.name if len(self.name) <= TITLE else self.name[: TITLE - 1] + "…"

    @property
    def role(self) -> Role:
        """To be in, to stay out of, or both."""
        kinds = {use.negative for use in self.uses}
        return "mixed" if len(kinds) != 1 else "avoid" if kinds.pop() else "reach"

    @property
    def visited(self) -> bool:
        """Whether it is enough to have been there."""
        return self.role == "reach" and all(use.visit for use in self.uses)

    @property
    def windows(self) -> tuple[Window, ...]:
        """When it matters; empty where it always does."""
        found = [use.window for use in self.uses]
        return tuple(dict.fromkeys(window for window in found if window)) if all(found) else ()

    def active(self, seconds: float) -> bool:
        """Whether it matters at this time."""
        return not self.windows or any(low <= seconds <= high for low, high in self.windows)

    def depth(self, points: Trace) -> NDArray[np.float64]:
        """Signed distance to the border, positive inside: (traces, samples)."""
        (margin,) = self.monitor.requirement_robustness(points).values()
        return np.atleast_2d(margin)


@dataclass(frozen=True, slots=True)
class Plane:
    """Two signals and the places that are regions of them.

    Attributes:
        axes: names of the two columns.
        places: in the order of the specification.
    """

    axes: tuple[str, str]
    places: tuple[Place, ...]

    def window(self, trace: Trace) -> tuple[Window, Window]:
        """What of the plane is worth seeing: paths, and places that are not cut off by twice their room."""
        ends = []
        for name in self.axes:
            values = trace.data[name][np.isfinite(trace.data[name])]
            ends.append(tuple(np.quantile(values, [0.01, 0.99])) if len(values) else (0.0, 1.0))
        size = max(high - low for low, high in ends) or 1.0
        search = [(low - size, high + size) for low, high in ends]
        lows, highs = [np.array([end[k] for end in ends]) for k in (0, 1)]
        for place in self.places:
            xs, ys, depth = self.sampled(place, trace, (search[0], search[1]), count=GRID // 2)
            inside = depth >= 0.0
            if inside.any() and not (inside[0] | inside[-1] | inside[:, 0] | inside[:, -1]).any():
                here = np.array([xs[inside.any(0)][[0, -1]], ys[inside.any(1)][[0, -1]]])
                lows, highs = np.minimum(lows, here[:, 0]), np.maximum(highs, here[:, 1])
        room = ROOM * float((highs - lows).max())
        lows, highs = lows - room, highs + room
        return (float(lows[0]), float(highs[0])), (float(lows[1]), float(highs[1]))

    def sampled(
        self,
        place: Place,
        like: Trace,
        window: tuple[Window, Window],
        *,
        count: int = GRID,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """The place's depth over a grid: the coordinates along both axes, and (y, x) values."""
        (left, right), (low, high) = window
        xs, ys = np.linspace(left, right, count), np.linspace(low, high, count)
        across, up = np.meshgrid(xs, ys)
        data = dict(zip(self.axes, (across, up), strict=True))
        columns = Signature(tuple(like.signature[name] for name in self.axes))
        grid = replace(like, signature=columns, data=data, extras={})
        return xs, ys, place.depth(grid)


def plane_of(spec: ast.Spec, rules: Iterable[CompiledRequirement], trace: Trace) -> Plane | None:
    """The plane with most places, each region once; None where the requirements name none.

    Regions that move with other signals and those of more than two dimensions are left out.

    Args:
        spec: what was written.
        rules: its requirements, compiled for recorded traces.
        trace: on which they are judged.
    """
    members = {_key(node.span): node for node in descendants(spec) if isinstance(node, ast.Member)}
    uses: dict[tuple[str, str], list[Use]] = {}
    for rule in rules:
        for pred, use in _uses(rule, trace):
            node = members.get(_key(pred.span))
            if node is not None:
                if node.negated and _point(node) is not node.item:  # a complement, not a `not` around it
                    use = _turned(use)
                uses.setdefault(_texts(node), []).append(use)
    found: list[tuple[tuple[str, ...], Place]] = []
    shown = {_texts(node): node for node in members.values()}
    for key, its in uses.items():
        judge = _judge_of(spec, shown[key], trace)
        if judge is not None:
            columns = judge.compiled.signature.names
            found.append((columns, Place(key[1], tuple(its), judge)))
    flat = [columns for columns, _ in found if len(columns) == 2 and all(c in trace.data for c in columns)]
    if not flat:
        return None
    axes = Counter(flat).most_common(1)[0][0]
    return Plane((axes[0], axes[1]), tuple(place for columns, place in found if columns == axes))


def _judge_of(spec: ast.Spec, node: ast.Member, trace: Trace) -> Monitor | None:
    """A monitor of one membership alone; None where it cannot stand alone (it names a formal, say)."""
    declared = tuple(item for item in spec.items if not isinstance(item, (ast.Require, ast.Assume)))
    alone = ast.Require(
        name="inside",
        name_span=node.span,
        tags=(),
        doc="",
        span=node.span,
        formula=replace(node, item=_point(node), negated=False),
    )
    try:
        judge = Monitor(replace(spec, items=(*declared, alone)), dt=trace.dt, overrides=trace.meta.spec_set)
        return judge if judge.compiled.requirements else None
    except StlcError:
        return None


# ------------------------------------------------------------------ in requirements


def _uses(rule: CompiledRequirement, trace: Trace) -> Iterator[tuple[typed.Predicate, Use]]:
    """Every predicate of a requirement, with its polarity and the time in which it matters."""
    stack: list[tuple[typed.Formula, Use]] = [(rule.typed.formula, Use(rule.name, negative=False))]
    while stack:
        node, use = stack.pop()
        match node:
            case typed.Predicate():
                yield node, use
            case typed.Not(body=body):
                stack.append((body, _turned(use)))
            case typed.Logic(op="->", items=(left, right)):
                stack += [(right, use), (left, _turned(use))]
            case typed.Temporal(op=op, interval=interval, body=body):
                inner = replace(_within(interval, use, rule, trace), visit=op in ("eventually", "once"))
                stack.append((body, inner))
            case typed.Until(interval=interval, left=left, right=right):
                inner = replace(_within(interval, use, rule, trace), visit=True)
                stack += [(right, inner), (left, use)]
            case _:
                stack += [(part, use) for part in reversed(operands(node))]


def _turned(use: Use) -> Use:
    return replace(use, negative=not use.negative)


def _within(interval: typed.Interval, use: Use, rule: CompiledRequirement, trace: Trace) -> Use:
    """The use as seen by an operand, its time in seconds of the trace; unchanged where it slides."""
    slides = rule.windowed or (rule.absolute and use.window is None)
    low, high = _seconds(interval.lo, trace), _seconds(interval.hi, trace)
    if low is None or high is None or (interval.clock == "now" and slides):
        return use
    if interval.clock == "now" and use.window is not None:
        low, high = use.window[0] + low, use.window[1] + high
    return replace(use, window=(low, high))


def _seconds(time: typed.Time | None, trace: Trace) -> float | None:
    if time is None or time.horizons:
        return None
    return float(time.seconds) + float(time.steps) * trace.dt


def _key(span: Span) -> tuple[str, int, int]:
    return span.source.name, span.start, span.end


def _point(node: ast.Member) -> ast.Expr:
    """The point that is asked about: that of `sweep(p)` is `p`."""
    match node.item:
        case ast.Call(func=ast.Name(name="sweep"), args=(arg,)):
            return arg.value
        case _:
            return node.item


def _texts(node: ast.Member) -> tuple[str, str]:
    """What tells a place from others: its point and its region."""
    return _text(_point(node)), _text(node.region)


def _text(node: ast.Node) -> str:
    return " ".join(node.span.text.split())


def labelled(uses: Sequence[Use]) -> str:
    """What the specification asks of a place, in a few words."""
    parts = []
    for use in uses:
        when = "" if use.window is None else f" {use.window[0]:g} to {use.window[1]:g} s"
        parts.append(f"{use.requirement}{when}")
    return ", ".join(dict.fromkeys(parts))
