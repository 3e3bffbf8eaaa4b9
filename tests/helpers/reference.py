"""Slow evaluators written from the definitions, to hold the compiler to.

Nothing here is clever: recursion over the typed formula at one instant, plain Python floats, exact fractions
for time. `robustness` gives an interval (low, high) over all continuations of the trace; where the trace is
known or windows are cut both ends are equal. `holds` is the Boolean semantics. `EXTREMA` are minima and
maxima of every semantics, each from its paper's equation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid

Interval = tuple[float, float]
UNKNOWN: Interval = (-math.inf, math.inf)
TRUE: Interval = (math.inf, math.inf)
FALSE: Interval = (-math.inf, -math.inf)


@dataclass(frozen=True)
class Trace:
    """One trace. Windows beyond its end are undefined ("strict"), cut ("truncate") or unknown ("open")."""

    columns: Mapping[str, Sequence[float]]
    grid: Grid
    end: Literal["strict", "truncate", "open"] = "strict"
    held: Mapping[str, float | None] = field(default_factory=dict)
    """Values of the enclosing `freeze`; None where it has no value."""
    stop: int = 0
    """Final number of samples, where the end is "open" and that is more than are known."""

    @property
    def samples(self) -> int:
        return len(next(iter(self.columns.values())))

    @property
    def length(self) -> int:
        """End of windows that reach to the end."""
        return max(self.samples, self.stop) if self.end == "open" else self.samples

    def row(self, t: int) -> Row:
        return Row(self, t)

    def has(self, num: ir.Num, t: int) -> bool:
        """True if everything exists that a number reads at sample `t`."""
        return 0 <= t < self.samples and all(self._there(leaf, t) for leaf in _leaves(num))

    def _there(self, leaf: ir.Num, t: int) -> bool:
        match leaf:
            case ir.ShiftedSignal(_, steps, clamped):
                return clamped or 0 <= t + steps < self.samples
            case ir.FrozenVar(name):
                return self.held[name] is not None
        return True


def _leaves(node: object) -> Iterator[ir.Num]:
    """Columns, other samples and frozen values, wherever they stand."""
    match node:
        case ir.Signal() | ir.ShiftedSignal() | ir.FrozenVar():
            yield node
        case ir.Op(_, args) | ir.Extern(_, args):
            yield from (leaf for arg in args for leaf in _leaves(arg))
        case ir.Indicator(cond):
            yield from _leaves(cond)
        case ir.Where(cond, yes, no):
            yield from (leaf for part in (cond, yes, no) for leaf in _leaves(part))
        case ir.Predicate(num):
            yield from _leaves(num)
        case ir.BoolOp(_, items):
            yield from (leaf for item in items for leaf in _leaves(item))


class Row(Mapping[str, float]):
    """One sample of a trace, from where others can be seen."""

    def __init__(self, trace: Trace, t: int) -> None:
        self.trace, self.t = trace, t

    def __getitem__(self, name: str) -> float:
        return float(self.trace.columns[name][self.t])

    def __iter__(self) -> Iterator[str]:
        return iter(self.trace.columns)

    def __len__(self) -> int:
        return len(self.trace.columns)

    def at(self, leaf: ir.ShiftedSignal) -> float:
        there = self.t + leaf.steps
        if leaf.clamped:
            there = min(max(there, 0), self.trace.samples - 1)
        return float(self.trace.columns[leaf.name][there])

    def held(self, leaf: ir.FrozenVar) -> float:
        value = self.trace.held[leaf.name]
        assert value is not None
        return value


# ---------------------------------------------------------------------- numbers

_PLAIN = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "mod": lambda a, b: a % b,
    "pow": lambda a, b: a**b,
    "neg": lambda a: -a,
    "square": lambda a: a * a,
    "abs": abs,
    "min": min,
    "max": max,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "log": math.log,
    "log10": math.log10,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "sinh": math.sinh,
    "cosh": math.cosh,
    "tanh": math.tanh,
    "asin": math.asin,
    "acos": math.acos,
    "atan": math.atan,
    "atan2": math.atan2,
    "sign": lambda a: math.copysign(1.0, a) if a else 0.0,
    "floor": math.floor,
    "ceil": math.ceil,
    "round": round,
    "clip": lambda a, low, high: min(max(a, low), high),
    "relu": lambda a: max(a, 0.0),
    "norm": lambda *a: math.sqrt(sum(x * x for x in a)),
    "norm1": lambda *a: sum(map(abs, a)),
    "norminf": lambda *a: max(map(abs, a)),
}


def number(num: ir.Num, row: Mapping[str, float]) -> float:
    """A number at one instant, conditions switched exactly."""
    match num:
        case ir.Const(value):
            return value
        case ir.Signal(name):
            return row[name]
        case ir.ShiftedSignal():
            return row.at(num)
        case ir.FrozenVar():
            return row.held(num)
        case ir.Op(name, args):
            return float(_PLAIN[name](*[number(arg, row) for arg in args]))
        case ir.Indicator(cond):
            return 1.0 if true(cond, row) else 0.0
        case ir.Where(cond, yes, no):
            return number(yes if true(cond, row) else no, row)
    raise TypeError(num)


def true(cond: ir.Formula, row: Mapping[str, float]) -> bool:
    """The truth of a state formula of the IR."""
    match cond:
        case ir.Truth(value):
            return value
        case ir.Predicate(num, sign, strict):
            value = sign * number(num, row)
            return value > 0 if strict else value >= 0
        case ir.BoolOp(op, items):
            return (all if op == "and" else any)(true(item, row) for item in items)
    raise TypeError(cond)


# ------------------------------------------------------------------------- time


def _steps(time: typed.Time, grid: Grid) -> Fraction:
    seconds = time.seconds / grid.dt if grid.dt else Fraction(0)
    return seconds + time.steps + time.horizons * (grid.horizon or 0)


def distances(interval: typed.Interval, grid: Grid, most: int, *, outward: bool) -> list[int]:
    """Distances in steps, up to `most`, of the samples that an interval covers."""
    low = _steps(interval.lo, grid)
    high = None if interval.hi is None else _steps(interval.hi, grid)
    inside = [
        k
        for k in range(most + 1)
        if (k > low if interval.lo_open else k >= low)
        and (high is None or (k < high if interval.hi_open else k <= high))
    ]
    if outward:
        if low.denominator != 1 and math.floor(low) <= most:
            inside = [math.floor(low), *inside]
        if high is not None and high.denominator != 1 and math.ceil(high) <= most:
            inside = [*inside, math.ceil(high)]
    return inside


# ------------------------------------------------------------------- robustness


Extremum: TypeAlias = Callable[[Sequence[float], Literal["min", "max"]], float]
"""The minimum or the maximum of at least one value."""


def exact(values: Sequence[float], pick: Literal["min", "max"]) -> float:
    """As they are."""
    return min(values) if pick == "min" else max(values)


def _by_minimum(minimum: Callable[[Sequence[float]], float]) -> Extremum:
    """From the minimum of two or more finite values; the maximum is its mirror.

    Infinite values are neutral or decide, and one value alone stands for itself.
    """

    def extremum(values: Sequence[float], pick: Literal["min", "max"]) -> float:
        if pick == "max":
            return -extremum([-value for value in values], "min")
        finite = [value for value in values if value < math.inf]
        if -math.inf in finite:
            return -math.inf
        if len(finite) < 2:
            return finite[0] if finite else math.inf
        return minimum(finite)

    return extremum


def log_sum_exp(k: float) -> Extremum:
    """The paper's smooth operators, at scale `k`."""

    def minimum(values: Sequence[float]) -> float:
        least = min(values)
        return least - math.log(sum(math.exp(-k * (value - least)) for value in values)) / k

    return _by_minimum(minimum)


def _arithmetic_geometric(values: Sequence[float]) -> float:
    """Mehdipour, Vasile and Belta (ACC 2019)."""
    if min(values) > 0:
        return math.exp(sum(math.log1p(value) for value in values) / len(values)) - 1
    return sum(min(value, 0.0) for value in values) / len(values)


def generalized_mean(eps: float) -> Extremum:
    """D-GMSR of order 1: Uzun, Elango, Garoche and Acikmese (2024)."""

    def minimum(values: Sequence[float]) -> float:
        n = len(values)
        product = math.prod(max(value, 0.0) ** 2 for value in values)
        power = sum(min(value, 0.0) ** 2 for value in values) / n
        return math.sqrt((eps**n + product) ** (1 / n)) - math.sqrt(eps + power)

    return _by_minimum(minimum)


EXTREMA: Mapping[str, Extremum] = {
    "exact": exact,
    "smooth": log_sum_exp(2.0),
    "agm": _by_minimum(_arithmetic_geometric),
    "dgmsr": generalized_mean(0.1),
}


def _negated(value: Interval | None) -> Interval | None:
    return None if value is None else (-value[1], -value[0])


class Robustness:
    """Robustness of typed formulas on one trace, remembered per node and instant."""

    def __init__(self, trace: Trace, extremum: Extremum = exact) -> None:
        self.trace, self.extremum = trace, extremum
        self._known: dict[tuple[int, int, bool], Interval | None] = {}
        self._alive: list[typed.Formula] = []

    def at(self, node: typed.Formula, t: int, positive: bool = True) -> Interval | None:
        """The value at `t`, or None where it is undefined. `positive`: under an even number of negations."""
        key = (id(node), t, positive)
        if key not in self._known:
            self._alive.append(node)
            self._known[key] = self._at(node, t, positive)
        return self._known[key]

    def _at(self, node: typed.Formula, t: int, positive: bool) -> Interval | None:
        match node:
            case typed.Truth(_, value):
                return TRUE if value else FALSE
            case typed.Predicate(_, num, strict, guard):
                return self._pred(num, strict, guard, t)
            case typed.Not(_, body):
                return _negated(self.at(body, t, not positive))
            case typed.Logic():
                return self._logic(node, t, positive)
            case typed.Temporal():
                return self._temporal(node, t, positive)
            case typed.Until():
                return self._until(node, t, positive)
            case typed.Shift(_, steps, body):
                return self._shift(body, t + steps, positive)
            case typed.Edge(_, op, body):
                now = self.at(body, t, positive if op == "rise" else not positive)
                if t == 0:
                    return None if now is None else FALSE
                before = self.at(body, t - 1, not positive if op == "rise" else positive)
                return self._most([now, _negated(before)] if op == "rise" else [_negated(now), before], "min")
            case typed.Freeze():
                inner = _frozen(node, self.trace, t)
                if self.trace.end == "strict" and None in inner.held.values():
                    return None
                return Robustness(inner, self.extremum).at(node.body, t, positive)
        raise TypeError(node)

    def _most(self, values: Sequence[Interval | None], pick: Literal["min", "max"]) -> Interval | None:
        if any(value is None for value in values):
            return None
        known = [value for value in values if value is not None]
        if not known:
            return TRUE if pick == "min" else FALSE
        return self.extremum([low for low, _ in known], pick), self.extremum(
            [high for _, high in known], pick
        )

    def _pred(self, num: ir.Num, strict: bool, guard: bool, t: int) -> Interval | None:
        if not self.trace.has(num, t):
            return {"strict": None, "truncate": FALSE, "open": UNKNOWN}[self.trace.end]
        value = number(num, self.trace.row(t))
        if guard:
            return TRUE if (value > 0 if strict else value >= 0) else FALSE
        return value, value

    def _logic(self, node: typed.Logic, t: int, positive: bool) -> Interval | None:
        if node.op in ("and", "or"):
            return self._most(
                [self.at(i, t, positive) for i in node.items], "min" if node.op == "and" else "max"
            )
        if node.op == "if":
            cond, yes, no = node.items
            first = self._most([self.at(cond, t, positive), self.at(yes, t, positive)], "min")
            second = self._most([_negated(self.at(cond, t, not positive)), self.at(no, t, positive)], "min")
            return self._most([first, second], "max")
        left, right = node.items
        if node.op == "->":
            return self._most([_negated(self.at(left, t, not positive)), self.at(right, t, positive)], "max")
        if node.op == "xor":
            return _negated(self.at(typed.Logic(node.span, "<->", node.items), t, not positive))
        there = self.at(typed.Logic(node.span, "->", (left, right)), t, positive)
        back = self.at(typed.Logic(node.span, "->", (right, left)), t, positive)
        return self._most([there, back], "min")

    def _window(self, interval: typed.Interval, t: int, outward: bool) -> list[int] | None:
        """Instants of a window of the future; None: it leaves a strict trace; [-1]: nobody knows."""
        samples, length = self.trace.samples, self.trace.length
        most = 4 * length + 64
        if interval.hi is None:
            found = [
                t + k for k in distances(interval, self.trace.grid, most, outward=outward) if t + k < length
            ]
            if found or self.trace.end == "truncate":
                return found
            return None if self.trace.end == "strict" else [-1]
        found = [t + k for k in distances(interval, self.trace.grid, most, outward=outward)]
        if self.trace.end == "strict" and any(k >= samples for k in found):
            return None
        return found if self.trace.end == "open" else [k for k in found if k < samples]

    def _before(self, interval: typed.Interval, t: int, outward: bool) -> list[int]:
        return [t - k for k in distances(interval, self.trace.grid, t, outward=outward)]

    def _temporal(self, node: typed.Temporal, t: int, positive: bool) -> Interval | None:
        every = node.op in ("always", "historically")
        future = node.op in ("always", "eventually")
        instants = (self._window if future else self._before)(node.interval, t, every is positive)
        if instants is None:
            return None
        if instants == [-1]:
            return UNKNOWN
        return self._most([self.at(node.body, k, positive) for k in instants], "min" if every else "max")

    def _until(self, node: typed.Until, t: int, positive: bool) -> Interval | None:
        match node.op:
            case "until":
                instants = self._window(node.interval, t, not positive)
                return self._met(node.left, node.right, (t, instants), positive)
            case "release":
                dual = self._met(
                    typed.Not(node.span, node.left),
                    typed.Not(node.span, node.right),
                    (t, self._window(node.interval, t, positive)),
                    not positive,
                )
                return _negated(dual)
            case "since":
                instants = self._before(node.interval, t, not positive)
                return self._met(node.left, node.right, (t, instants), positive)
            case "unless":
                whole = typed.Interval(typed.Time(), node.interval.hi, False, node.interval.hi_open)
                held = self.at(typed.Temporal(node.span, "always", whole, node.left), t, positive)
                met = self.at(
                    typed.Until(node.span, "until", node.interval, node.left, node.right), t, positive
                )
                return self._most([held, met], "max")

    def _met(
        self, left: typed.Formula, right: typed.Formula, when: tuple[int, list[int] | None], positive: bool
    ) -> Interval | None:
        """sup over t' of min(right(t'), inf of left between now and t', both included)."""
        t, instants = when
        if instants is None:
            return None
        if instants == [-1]:
            return UNKNOWN
        values = []
        for k in instants:
            between = [self.at(left, i, positive) for i in range(min(t, k), max(t, k) + 1)]
            values.append(self._most([self.at(right, k, positive), self._most(between, "min")], "min"))
        return self._most(values, "max")

    def _shift(self, body: typed.Formula, t: int, positive: bool) -> Interval | None:
        if 0 <= t < self.trace.samples or (t >= 0 and self.trace.end == "open"):
            return self.at(body, t, positive)
        return {"strict": None, "truncate": FALSE, "open": UNKNOWN}[self.trace.end]


def _frozen(node: typed.Freeze, trace: Trace, t: int) -> Trace:
    """The trace with what `node` binds at `t`."""
    values = {name: number(num, trace.row(t)) if trace.has(num, t) else None for name, num in node.bindings}
    return replace(trace, held={**trace.held, **values})


def robustness(formula: typed.Formula, trace: Trace, t: int = 0) -> Interval | None:
    """Robustness of `formula` at sample `t`; None where it is undefined."""
    return Robustness(trace).at(formula, t)


# ------------------------------------------------------------- Boolean semantics


def holds(formula: typed.Formula, trace: Trace, t: int = 0) -> bool:
    """Truth of `formula` at sample `t`, windows cut to the trace, bounds on the grid."""
    match formula:
        case typed.Truth(_, value):
            return value
        case typed.Predicate(_, num, strict):
            value = number(num, trace.row(t)) if trace.has(num, t) else -math.inf
            return value > 0 if strict else value >= 0
        case typed.Freeze(_, _, body):
            return holds(body, _frozen(formula, trace, t), t)
        case typed.Not(_, body):
            return not holds(body, trace, t)
        case typed.Logic(_, op, items):
            values = [holds(item, trace, t) for item in items]
            match op:
                case "and":
                    return all(values)
                case "or":
                    return any(values)
                case "->" | "if":
                    return values[1] if values[0] else op == "->" or values[2]
                case "<->":
                    return values[0] is values[1]
                case "xor":
                    return values[0] is not values[1]
        case typed.Temporal(_, op, interval, body):
            ahead = distances(interval, trace.grid, trace.samples, outward=False)
            sign = 1 if op in ("always", "eventually") else -1
            instants = [t + sign * k for k in ahead if 0 <= t + sign * k < trace.samples]
            quantifier = all if op in ("always", "historically") else any
            return quantifier(holds(body, trace, k) for k in instants)
        case typed.Until():
            return _until_holds(formula, trace, t)
        case typed.Shift(_, steps, body):
            return 0 <= t + steps < trace.samples and holds(body, trace, t + steps)
        case typed.Edge(_, op, body):
            now, before = holds(body, trace, t), t > 0 and holds(body, trace, t - 1)
            return t > 0 and ((now and not before) if op == "rise" else (before and not now))
    raise TypeError(formula)


def _until_holds(formula: typed.Until, trace: Trace, t: int) -> bool:
    left, right = formula.left, formula.right
    ahead = distances(formula.interval, trace.grid, trace.samples, outward=False)
    sign = -1 if formula.op == "since" else 1
    instants = [t + sign * k for k in ahead if 0 <= t + sign * k < trace.samples]

    def between(k: int) -> range:
        return range(min(t, k), max(t, k) + 1)

    if formula.op == "release":
        return all(holds(right, trace, k) or any(holds(left, trace, i) for i in between(k)) for k in instants)
    met = any(holds(right, trace, k) and all(holds(left, trace, i) for i in between(k)) for k in instants)
    if formula.op == "unless" and not met:
        whole = typed.Interval(typed.Time(), formula.interval.hi, False, formula.interval.hi_open)
        return holds(typed.Temporal(formula.span, "always", whole, left), trace, t)
    return met
