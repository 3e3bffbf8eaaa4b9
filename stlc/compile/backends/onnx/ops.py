"""Operations on symbolic arrays, and robustness of formulas, both recorded as an ONNX graph.

Conditions and robustness are exact; gradients and smooth extrema are not supported. Numbers are float64. The
ONNX runtime has some functions, such as `atan`, in float32 only. One Newton step then gives full precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TypeAlias, cast, final

from stlc.compile.backends.array.arith import ArrayProgram, inputs
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.backends.onnx.graph import BATCH, Attribute, GraphBody, Kind, OnnxGraph, Value, joined
from stlc.compile.backends.schedule import spanning
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.defined import defined
from stlc.compile.namespace import FloatConstants, Ops, Pick, ScanByRows, Sliding

Number: TypeAlias = Value | float
_ScanBody: TypeAlias = Callable[[Sequence[Value], Sequence[Value]], tuple[Sequence[Value], Sequence[Value]]]

UNROLLED_NODES = 600
"""Nodes up to which a loop is unrolled: a `Scan` node costs some microseconds per iteration."""


def _like(*numbers: Number) -> Value:
    return next(number for number in numbers if isinstance(number, Value))


def _two(op: str, a: Number, b: Number, kind: Kind | None = None) -> Value:
    like = _like(a, b)
    return like.beside(a).apply(op, b, kind=kind)


def _unary(op: str) -> Callable[[OnnxOps, Value], Value]:
    return lambda _, x: x.apply(op)


def _binary(op: str) -> Callable[[OnnxOps, Number, Number], Value]:
    return lambda _, a, b: _two(op, a, b)


def _comparison(op: str) -> Callable[[OnnxOps, Number, Number], Value]:
    return lambda _, a, b: _two(op, a, b, "bool")


@final
class OnnxOps(FloatConstants, ScanByRows):
    """Implementation of `stlc.compile.namespace.Ops` for symbolic arrays.

    If an operand of min or max is NaN, so is the result.
    """

    name = "onnx"

    # operators of ONNX, elementwise
    add, sub, mul, div, pow = map(_binary, ("Add", "Sub", "Mul", "Div", "Pow"))
    abs, sign, floor, ceil, round = map(_unary, ("Abs", "Sign", "Floor", "Ceil", "Round"))
    sqrt, exp, log, sin, cos, tanh = map(_unary, ("Sqrt", "Exp", "Log", "Sin", "Cos", "Tanh"))
    minimum, maximum = map(_binary, ("Min", "Max"))
    gt, ge = map(_comparison, ("Greater", "GreaterOrEqual"))
    both, either = map(_binary, ("And", "Or"))

    # ----------------------------------------------------------------- arithmetic

    def axpy(self, a: Number, b: Value, factor: float) -> Value:
        return _two("Add", a, b * factor)

    def addcmul(self, a: Number, b: Value, c: Value, factor: float) -> Value:
        product = b * c
        return _two("Add", a, product if factor == 1.0 else product * factor)

    def square(self, x: Value) -> Value:
        return x * x

    def mod(self, a: Number, b: Number) -> Value:
        like = _like(a, b)
        divisor = like.beside(b)
        dividend = like.beside(a)
        shape = dividend.broadcast(divisor)
        (rest,) = like.graph.emit("Mod", (dividend, divisor), [shape], like.kind, {"fmod": 1})
        other = (rest * divisor).apply("Less", 0.0, kind="bool")
        return self.where(other, rest + divisor, rest)

    def norm(self, *components: Number) -> Value:
        first, *rest = components
        total = self.mul(first, first) if isinstance(first, Value) else first * first
        for part in rest:
            total = self.add(total, part * part) if isinstance(total, Value) else part * part + total
        assert isinstance(total, Value)
        return total.apply("Sqrt")

    def log10(self, x: Value) -> Value:
        return x.apply("Log") / math.log(10.0)

    def sinh(self, x: Value) -> Value:
        """Hyperbolic sine, as `tanh(x) cosh(x)`, which is exact to rounding also near 0."""
        return x.apply("Tanh") * self.cosh(x)

    def cosh(self, x: Value) -> Value:
        return (x.apply("Exp") + (-x).apply("Exp")) / 2.0

    # ------------------------------------------------------------------ angles

    def tan(self, x: Value) -> Value:
        return x.apply("Sin") / x.apply("Cos")

    def atan(self, x: Value) -> Value:
        return self.atan2(x, 1.0)

    def asin(self, x: Value) -> Value:
        """Arc sine; NaN outside [-1, 1]."""
        return self.atan2(x, ((1.0 - x) * (1.0 + x)).apply("Sqrt"))

    def acos(self, x: Value) -> Value:
        """Arc cosine; NaN outside [-1, 1]."""
        return self.atan2(((1.0 - x) * (1.0 + x)).apply("Sqrt"), x)

    def atan2(self, a: Number, b: Number) -> Value:
        like = _like(a, b)
        y, x = like.beside(a), like.beside(b)
        tall, wide = y.apply("Abs"), x.apply("Abs")
        longer = tall.apply("Max", wide)
        none = longer.apply("Equal", 0.0, kind="bool")
        slope = tall.apply("Min", wide) / self.where(none, 1.0, longer)
        angle = slope.cast("float32").apply("Atan").cast(slope.kind)
        if slope.kind != "float32":  # improve by one Newton step
            sine, cosine = angle.apply("Sin"), angle.apply("Cos")
            angle = angle + (slope * cosine - sine) / (cosine + slope * sine)
        angle = self.where(self.gt(tall, wide), math.pi / 2 - angle, angle)
        angle = self.where(_negative(x), math.pi - angle, angle)
        return self.where(_negative(y), -angle, angle)

    # ------------------------------------------------------------------- truth

    def number(self, mask: Value, like: Value) -> Value:
        return mask.cast(like.kind)

    def where(self, mask: Value, yes: Number, no: Number) -> Value:
        kind: Kind = next((each.kind for each in (yes, no) if isinstance(each, Value)), "float64")
        parts = [each if isinstance(each, Value) else mask.graph.constant(each, kind) for each in (yes, no)]
        return mask.apply("Where", *parts, kind=kind)

    def infinite(self, mask: Value, _like: Value) -> Value:
        return self.where(mask, math.inf, -math.inf)

    def clamp(self, x: Value, low: float | None, high: float | None) -> Value:
        if low is not None and high is not None:
            return x.apply("Clip", low, high)
        x = x if low is None else x.apply("Max", low)
        return x if high is None else x.apply("Min", high)

    # -------------------------------------------------------------- along time

    def join(self, items: Sequence[Value], pick: Pick) -> Value:
        first, *rest = items
        return first.apply("Min" if pick == "min" else "Max", *rest) if rest else first

    def amin(self, x: Value) -> Value:
        return self.join(x.rows(), "min")

    def amax(self, x: Value) -> Value:
        return self.join(x.rows(), "max")

    def sum(self, x: Value) -> Value:
        axes = x.graph.constant([0], "int64")
        (out,) = x.graph.emit("ReduceSum", (x, axes), [(1, *x.shape[1:])], x.kind, {"keepdims": 1})
        return out

    def cummin(self, x: Value) -> Value:
        return _running(x, "Min")

    def cummax(self, x: Value) -> Value:
        return _running(x, "Max")

    def accumulate(self, start: Value, x: Value) -> Value:
        parts = self.cat([start, x])
        (out,) = x.graph.emit("CumSum", (parts, x.graph.constant(0, "int64")), [parts.shape], x.kind)
        return out

    def scan(
        self, body: _ScanBody, carry: Sequence[Value], rows: Sequence[Value], count: int
    ) -> Sequence[Sequence[Value]]:
        """Write a loop: unrolled if it is short, else as a `Scan` node."""

        def shaped(now: Sequence[Value], taken: Sequence[Value]) -> tuple[list[Value], Sequence[Value]]:
            later, found = body(now, taken)
            return [to.expand(*at.shape, like=at) for at, to in zip(now, later, strict=True)], found

        graph = carry[0].graph
        inner = OnnxGraph(prefix=f"{graph.prefix}s{len(graph.nodes)}.")
        now = [inner.input(f"{inner.prefix}i{i}", each.shape, each.kind) for i, each in enumerate(carry)]
        timed = [each for each in rows if len(each) == count] or [graph.constant([[0.0]] * count)]
        row = [inner.input(f"{inner.prefix}r{i}", each.shape[1:], each.kind) for i, each in enumerate(timed)]
        taken = iter([each.reshaped(1, *each.shape) for each in row])
        later, found = shaped(now, [next(taken) if len(each) == count else each.on(inner) for each in rows])
        written = GraphBody(inner, (*later, *found))
        if count * len(written.nodes) <= UNROLLED_NODES:
            return super().scan(shaped, carry, rows, count)
        shapes = [each.shape for each in later] + [(count, *each.shape) for each in found]
        facts: dict[str, Attribute] = {"body": written, "num_scan_inputs": len(timed)}
        outputs = graph.emit("Scan", (*carry, *timed), shapes, carry[0].kind, facts)
        return [[each.reshaped(count, *each.shape[2:])] for each in outputs[len(later) :]]

    def windows(self, operands: Sequence[Value], pick: Pick, window: Sliding) -> None:
        """Return None: there is no special method for windows."""

    # ------------------------------------------------------ constants and shapes

    def kind(self, like: Value) -> Hashable:
        """Return the element type of the array `like`.

        Arrays with equal element types can share converted constants.
        """
        return like.kind

    def full(self, shape: tuple[int, ...], value: float, like: Value) -> Value:
        """Array of a constant; an unknown batch size becomes 1, which broadcasts."""
        known = like.graph.constant(value, like.kind)
        return known.expand(*(1 if length == BATCH else length for length in shape))

    def counted(self, first: int, count: int, like: Value) -> Value:
        """Array with the numbers `first`, `first + 1`, …, `first + count - 1` along time.

        The other dimensions are those of `like`. An unknown batch size becomes 1.
        """
        numbers = like.graph.constant([[float(k)] for k in range(first, first + count)], like.kind)
        return numbers.expand(count, *(1 if length == BATCH else length for length in like.shape[1:]))

    def cat(self, parts: Sequence[Value]) -> Value:
        widest = max(parts, key=lambda part: part.shape[-1])
        return joined([part.expand(part.shape[0], *widest.shape[1:], like=widest) for part in parts])

    def split(self, x: Value) -> Sequence[Value]:
        return x.rows()

    def repeat(self, x: Value, count: int) -> Value:
        return x.expand(count, *x.shape[1:])

    def flip(self, x: Value) -> Value:
        return x[::-1] if x.shape[0] > 1 else x

    def quiet(self) -> AbstractContextManager[object]:
        """Empty context, since nothing is computed while a graph is recorded."""
        return nullcontext()


def _negative(x: Value) -> Value:
    """Mask that is True where `x` is negative or -0."""
    return ONNX_OPS.where(x.apply("Equal", 0.0, kind="bool"), 1.0 / x, x).apply("Less", 0.0, kind="bool")


def _running(x: Value, op: str) -> Value:
    """Running minimum (`op` "Min") or maximum ("Max") along axis 0, in about log2(rows) operations."""
    size = 1
    while size < x.shape[0]:
        x = joined([x[:size], x[size:].apply(op, x[:-size])])
        size *= 2
    return x


ONNX_OPS = OnnxOps()
ONNX: Ops = cast("Ops", ONNX_OPS)


# --------------------------------------------------------------------- formulas

Columns = dict[str, Value]


def build_graph(
    formulas: Sequence[ir.Formula], columns: Mapping[str, Value], *, count: int = 1
) -> list[Value]:
    """Return the exact robustness of `formulas` at the first `count` samples.

    Args:
        formulas: formulas in negation normal form.
        columns: signal name -> value, `(samples, batch)`.
        count: number of samples, from the first on.

    Returns:
        For each formula a value (count, batch), or (count, 1) if it is constant.

    Raises:
        Untranslatable: a formula needs samples beyond the last one, or calls a Python function.
    """
    env = dict(columns)
    samples = len(next(iter(env.values())))
    for formula in formulas:
        require_numbers(formula.numbers())
        if not defined(formula, samples)[:count].all():
            raise Untranslatable("a sample outside of the plan")
    substituted = [_without_freeze(formula, env) for formula in formulas]
    found: list[Value] = evaluate(substituted, env, ops=ONNX, count=count)
    return found


def require_numbers(nums: Iterable[ir.Num]) -> None:
    """Raise Untranslatable if an expression calls a function that is known in Python only."""
    for num in nums:
        for part in num.subexpressions():
            if isinstance(part, ir.Extern) and not isinstance(part.function, ir.Body):
                raise Untranslatable(f"the function `{part.name}`")


def _without_freeze(formula: ir.Formula, env: Columns) -> ir.Formula:
    """Return the formula with each `freeze` replaced by a new signal, which is added to `env`."""
    if isinstance(formula, ir.Freeze):
        name = f"#frozen{len(env)}"
        env[name] = _frozen(formula, env)
        return ir.Predicate(ir.Signal(name))
    return formula.map_children(formulas=lambda part: _without_freeze(part, env))


def _frozen(node: ir.Freeze, env: Columns) -> Value:
    """Robustness of a `freeze` formula at all samples, `(samples, batch)`; NaN where undefined."""
    like = next(iter(env.values()))
    program, samples = ArrayProgram(dict(node.bindings)), len(like)
    rows = []
    for instant, known in enumerate(defined(node, samples)):
        if not known:
            rows.append(ONNX.full((1, 1), math.nan, like))
            continue
        held = program(inputs(program, env, spanning(instant, 1), ONNX), ONNX)
        inner = env | {name: value.expand(samples, value.shape[1]) for name, value in held.items()}
        body = _without_freeze(node.body, inner)
        rows += evaluate([body], inner, ops=ONNX, start=instant, count=1)
    column: Value = ONNX.cat(rows)
    return column
