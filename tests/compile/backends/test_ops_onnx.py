"""The operations of graphs equal those of NumPy, at the edges too."""

from __future__ import annotations

import math

import numpy as np
from helpers.emitted import OPERATIONS
from helpers.formula_strategies import NAMES
from helpers.onnx_graphs import columns_on, computed

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.onnx.graph import OnnxGraph
from stlc.compile.backends.onnx.ops import ONNX
from stlc.compile.ir import nodes as ir

ROWS = 7


def _agree(numbers: dict[str, ir.Num], env: dict[str, np.ndarray], tolerance: float = 1e-13) -> None:
    program = ArrayProgram(numbers)
    found = computed(program(columns_on(OnnxGraph(), tuple(env), len(env["x"])), ONNX), env)
    for name, wanted in program(env, NUMPY).items():
        value = np.broadcast_to(found[name], wanted.shape)
        np.testing.assert_allclose(value, wanted, rtol=tolerance, atol=tolerance, err_msg=name)


def _env(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.normal(0, 2, (ROWS, 50)) for name in NAMES}


def test_every_function_equals_the_evaluator() -> None:
    columns = tuple(ir.Signal(name) for name in NAMES)
    numbers = {name: ir.Op(name, columns[:arity]) for name, arity in OPERATIONS.items()}
    positive = ir.Op("abs", columns[:1])
    for name in ("sqrt", "log", "log10"):
        numbers[name] = ir.Op(name, (positive,))
    numbers["pow"] = ir.Op("pow", (positive, columns[1]))
    for name in ("asin", "acos"):
        numbers[name] = ir.Op(name, (ir.Op("sin", columns[:1]),))
    cond = ir.BoolOp("or", (ir.Predicate(columns[0], strict=True), ir.Predicate(columns[1], sign=-1)))
    numbers |= {"ind": ir.Indicator(cond), "where": ir.Where(cond, columns[2], ir.Const(0.1))}
    numbers |= {
        "constant": ir.Const(2.5),
        "clamp": ir.Op("clip", (columns[0], ir.Const(-1.0), ir.Const(0.5))),
    }
    _agree(numbers, _env(1))


def test_angles_are_exact_at_the_edges() -> None:
    values = [0.0, -0.0, 1.0, -1.0, 1e-300, -1e300, 0.3, math.nan]
    y, x = (np.array(grid).reshape(1, -1) for grid in np.meshgrid(values, values))
    known = np.isfinite(y) & np.isfinite(x)
    numbers = {
        "angle": ir.Op("atan2", (ir.Signal("y"), ir.Signal("x"))),
        "slope": ir.Op("atan", (ir.Signal("y"),)),
    }
    found = computed(ArrayProgram(numbers)(columns_on(OnnxGraph(), ("y", "x"), 1), ONNX), {"y": y, "x": x})
    np.testing.assert_allclose(found["angle"], np.where(known, np.arctan2(y, x), np.nan), rtol=1e-15)
    np.testing.assert_allclose(found["slope"], np.arctan(y), rtol=1e-15)


def test_remainders_have_the_sign_of_the_divisor() -> None:
    values = np.array([[-7.5, -2.0, -0.25, 0.0, 0.25, 2.0, 7.5, 4.0]])
    for divisor in (2.0, -2.0, 0.75):
        number = ir.Op("mod", (ir.Signal("x"), ir.Const(divisor)))
        _agree({"rest": number}, {"x": values}, tolerance=0.0)


def test_nan_is_not_lost() -> None:
    env = _env(2)
    env["x"][3, ::2] = math.nan
    x, y, _ = columns_on(OnnxGraph(), NAMES, ROWS).values()
    outputs = {
        "least": ONNX.amin(x),
        "most": ONNX.amax(x),
        "running": ONNX.cummin(x),
        "clamp": ONNX.clamp(x, -1.0, 1.0),
        "open": ONNX.clamp(x, None, 1.0),
        "pair": ONNX.maximum(y, x),
        "join": ONNX.join([y, x, y], "min"),
    }
    found = computed(outputs, env)
    with NUMPY.quiet():
        x, y = env["x"], env["y"]
        np.testing.assert_array_equal(found["least"], NUMPY.amin(x))
        np.testing.assert_array_equal(found["most"], NUMPY.amax(x))
        np.testing.assert_array_equal(found["running"], NUMPY.cummin(x))
        np.testing.assert_array_equal(found["clamp"], np.clip(x, -1.0, 1.0))
        np.testing.assert_array_equal(found["open"], np.minimum(x, 1.0))
        np.testing.assert_array_equal(found["pair"], np.maximum(y, x))
        np.testing.assert_array_equal(found["join"], np.minimum(y, x))
