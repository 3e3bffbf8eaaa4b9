"""Robustness as an operation graph: formulas over symbolic columns, `freeze` unrolled over instants."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from stlc.compile.backends.array.arith import ArrayProgram, inputs
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.backends.onnx.ops import ONNX
from stlc.compile.backends.onnx.sheet import Value
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.defined import defined
from stlc.compile.ir.traverse import map_children, numbers, subexpressions
from stlc.compile.schedule.schedule import spanning

Columns = dict[str, Value]


def written(formulas: Sequence[ir.Formula], columns: Mapping[str, Value], *, count: int = 1) -> list[Value]:
    """Return the exact robustness at the first `count` samples.

    Args:
        formulas: in negation normal form.
        columns: `(samples, batch)` each.
        count: number of samples, from the first on.

    Returns:
        For each formula a value (count, batch), or (count, 1) where it is a constant.

    Raises:
        Untranslatable: a formula needs samples beyond the last, or calls a Python function.
    """
    env = dict(columns)
    samples = len(next(iter(env.values())))
    for formula in formulas:
        require_numbers(numbers(formula))
        if not defined(formula, samples)[:count].all():
            raise Untranslatable("a sample outside of the plan")
    thawed = [_thawed(formula, env) for formula in formulas]
    found: list[Value] = evaluate(thawed, env, ops=ONNX, count=count)
    return found


def require_numbers(nums: Iterator[ir.Num] | Sequence[ir.Num]) -> None:
    """Raise Untranslatable where a number calls a function that is known in Python only."""
    for num in nums:
        for part in subexpressions(num):
            if isinstance(part, ir.Extern) and not isinstance(part.function, ir.Body):
                raise Untranslatable(f"the function `{part.name}`")


def _thawed(formula: ir.Formula, env: Columns) -> ir.Formula:
    """Return the formula with each `freeze` replaced by a new column of `env`."""
    if isinstance(formula, ir.Freeze):
        name = f"#frozen{len(env)}"
        env[name] = _frozen(formula, env)
        return ir.Predicate(ir.Signal(name))
    return map_children(formula, formulas=lambda part: _thawed(part, env))


def _frozen(node: ir.Freeze, env: Columns) -> Value:
    """Robustness of a `freeze` at all samples, `(samples, batch)`; NaN where undefined."""
    like = next(iter(env.values()))
    program, samples = ArrayProgram(dict(node.bindings)), len(like)
    rows = []
    for instant, known in enumerate(defined(node, samples)):
        if not known:
            rows.append(ONNX.full((1, 1), math.nan, like))
            continue
        held = program(inputs(program, env, spanning(instant, 1), ONNX), ONNX)
        inner = env | {name: value.spread(samples, value.shape[1]) for name, value in held.items()}
        body = _thawed(node.body, inner)
        rows += evaluate([body], inner, ops=ONNX, start=instant, count=1)
    column: Value = ONNX.cat(rows)
    return column
