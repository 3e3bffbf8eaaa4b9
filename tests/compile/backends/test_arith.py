from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import reference
from helpers.formula_strategies import NAMES, numbers, state_formulas
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.semantics.switch import Hard, StraightThrough, Switch, Tanh

X, Y, Z = (ir.Signal(name) for name in NAMES)


def op(name: str, *args: ir.Num | float) -> ir.Op:
    return ir.Op(name, tuple(ir.Const(arg) if isinstance(arg, float) else arg for arg in args))


def environment(seed: int, rows: int = 5) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.integers(-24, 24, rows) / 8 for name in NAMES}


def tensors(env: dict[str, np.ndarray], *, grad: bool = False) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value, requires_grad=grad) for name, value in env.items()}


def slow(num: ir.Num, env: dict[str, np.ndarray]) -> np.ndarray:
    rows = zip(*env.values(), strict=True)
    return np.array([reference.number(num, dict(zip(env, row, strict=True))) for row in rows])


@settings(max_examples=60)
@given(numbers, st.integers(0, 2**32 - 1))
def test_programs_compute_what_is_written(num: ir.Num, seed: int) -> None:
    env = environment(seed)
    program, wanted = ArrayProgram({"out": num}), slow(num, env)
    np.testing.assert_allclose(program(env, NUMPY)["out"], wanted, atol=1e-9, rtol=1e-9)
    out = program(tensors(env), TORCH)["out"]
    assert out.dtype == torch.float64
    np.testing.assert_allclose(out, wanted, atol=1e-9, rtol=1e-9)


@settings(max_examples=25)
@given(state_formulas(numbers), numbers, numbers, st.integers(0, 2**32 - 1))
def test_straight_through_steps_like_hard(cond: ir.Formula, yes: ir.Num, no: ir.Num, seed: int) -> None:
    env = tensors(environment(seed))
    program = ArrayProgram({"ind": ir.Indicator(cond), "where": ir.Where(cond, yes, no)})
    hard, soft = program(env, TORCH, Hard()), program(env, TORCH, StraightThrough(5.0))
    plain = program({name: value.numpy() for name, value in env.items()}, NUMPY, StraightThrough(5.0))
    for name in ("ind", "where"):
        np.testing.assert_allclose(soft[name], hard[name], atol=1e-9)
        np.testing.assert_allclose(plain[name], hard[name], atol=1e-9)


@pytest.mark.parametrize("name", [n for n, f in FUNCTIONS.items() if f.kind != "sampler"])
def test_every_function_of_the_table(name: str) -> None:
    """On arrays, on constants, and its gradient."""
    arity = max(FUNCTIONS[name].least, 2 if FUNCTIONS[name].most is None else 1)
    rng = np.random.default_rng(1)
    values = [rng.uniform(0.2, 0.9, 6) for _ in range(arity)]
    env = {f"c{i}": value for i, value in enumerate(values)}
    num = ir.Op(name, tuple(ir.Signal(column) for column in env))
    wanted = slow(num, env)
    fold = FUNCTIONS[name].fold
    assert fold is not None
    np.testing.assert_allclose(wanted, [fold(*row) for row in zip(*values, strict=True)], rtol=1e-12)
    np.testing.assert_allclose(ArrayProgram({"out": num})(env, NUMPY)["out"], wanted, rtol=1e-12)
    columns = tensors(env, grad=True)
    out = ArrayProgram({"out": num})(columns, TORCH)["out"]
    np.testing.assert_allclose(out.detach(), wanted, rtol=1e-12)
    constant = ArrayProgram({"out": ir.Op(name, tuple(ir.Const(float(value[0])) for value in values))})
    np.testing.assert_allclose(constant(env, NUMPY)["out"], np.full(6, wanted[0]), rtol=1e-12)
    mixed = ir.Op(name, (ir.Const(float(values[0][0])), *num.args[1:]))
    np.testing.assert_allclose(
        ArrayProgram({"out": mixed})(columns, TORCH)["out"][0].detach(), wanted[0], rtol=1e-12
    )
    out.sum().backward()
    for column, value in env.items():
        moved = [slow(num, {**env, column: value + side * 1e-6}) for side in (1, -1)]
        np.testing.assert_allclose(columns[column].grad, (moved[0] - moved[1]) / 2e-6, atol=1e-4)


X_PLUS = op("add", X, op("mul", Y, 0.1))


@pytest.mark.parametrize(
    ("num", "operations"),
    [
        (X_PLUS, 1),
        (op("sub", X, op("mul", 0.1, Y)), 1),
        (op("add", X, op("mul", op("mul", Y, Z), 0.1)), 1),
        (op("sub", X, op("mul", Y, Z)), 1),
        (op("add", X, op("neg", Y)), 1),
        (op("clip", X, -1.0, 1.0), 1),
        (op("min", op("max", X, -1.0), 1.0), 1),
        (op("relu", op("min", X, 3.0)), 1),
        (op("mul", X, X), 1),
        (op("pow", X, 2.0), 1),
        (op("neg", op("sub", X, Y)), 1),
        (op("neg", op("sub", 0.5, op("abs", X))), 2),
        (op("add", op("mul", X, 2.0), op("mul", 3.0, 4.0)), 2),
        (op("add", X, op("sub", 1.0, 1.0)), 0),
        (op("mul", X, 1.0), 0),
        (op("min", X, X), 0),
        (ir.Indicator(ir.Predicate(op("sub", X, Y))), 2),
        (op("mul", ir.Indicator(ir.Predicate(op("sub", X, Y))), Z), 3),
        (ir.Where(ir.Predicate(op("sub", X, Y)), Z, X_PLUS), 3),
        (ir.Where(ir.Truth(True), Z, X_PLUS), 0),
    ],
)
def test_few_operations(num: ir.Num, operations: int) -> None:
    """An `Ind` that is multiplied still converts its mask for others; a `where` needs the mask alone."""
    found = ArrayProgram({"out": num}).operations()
    assert found <= operations
    env = environment(7)
    np.testing.assert_allclose(ArrayProgram({"out": num})(env, NUMPY)["out"], slow(num, env), atol=1e-12)


def test_common_parts_are_computed_once() -> None:
    root = op("sqrt", op("add", op("square", X), op("square", Y)))
    twin = op("sqrt", op("add", op("square", ir.Signal("x")), op("square", ir.Signal("y"))))
    assert (
        ArrayProgram({"a": root, "b": op("add", twin, 1.0)}).operations()
        == ArrayProgram({"a": root}).operations() + 1
    )


@pytest.mark.parametrize("switch", [Hard(), StraightThrough(3.0)])
def test_exact_conditions_respect_strictness(switch: Switch) -> None:
    env = {"x": torch.tensor([-1.0, 0.0, 1.0]), "y": torch.zeros(3)}
    more, least = ir.Predicate(X, strict=True), ir.Predicate(X)
    program = ArrayProgram(
        {
            "gt": ir.Indicator(more),
            "ge": ir.Indicator(least),
            "lt": ir.Indicator(ir.Predicate(X, sign=-1, strict=True)),
            "both": ir.Indicator(ir.BoolOp("and", (least, ir.Predicate(op("neg", X))))),
            "mixed": ir.Indicator(ir.BoolOp("and", (least, ir.Predicate(X, sign=-1, strict=True)))),
            "either": ir.Where(ir.BoolOp("or", (more, ir.Predicate(op("sub", Y, 1.0)))), ir.Const(5.0), X),
        }
    )
    out = {name: value.tolist() for name, value in program(env, TORCH, switch).items()}
    assert out == {
        "gt": [0, 0, 1],
        "ge": [0, 1, 1],
        "lt": [1, 0, 0],
        "both": [0, 1, 0],
        "mixed": [0, 0, 0],
        "either": [-1, 0, 5],
    }


def test_tanh_is_the_papers_equation() -> None:
    rho = np.linspace(-0.02, 0.02, 9)
    cond = ir.BoolOp("and", (ir.Predicate(X), ir.Predicate(op("sub", X, Y), strict=False)))
    program = ArrayProgram(
        {
            "default": ir.Indicator(cond),
            "own": ir.Indicator(cond, sharpness=20.0),
            "mixed": ir.Indicator(ir.BoolOp("and", (ir.Predicate(X, strict=True), cond)), sharpness=20.0),
            "where": ir.Where(ir.Predicate(X), ir.Const(3.0), Y),
        }
    )
    out = program({"x": rho, "y": np.full(9, 0.01)}, NUMPY, Tanh(100.0))
    margin = np.minimum(rho, rho - 0.01)
    np.testing.assert_allclose(out["default"], (1 + np.tanh(100 * margin)) / 2, atol=1e-12)
    np.testing.assert_allclose(out["own"], (1 + np.tanh(20 * margin)) / 2, atol=1e-12)
    np.testing.assert_allclose(out["mixed"], (1 + np.tanh(20 * margin)) / 2, atol=1e-12)
    weight = (1 + np.tanh(100 * rho)) / 2
    np.testing.assert_allclose(out["where"], weight * 3 + (1 - weight) * 0.01, atol=1e-12)


def test_straight_through_differentiates_condition_and_branch() -> None:
    x = torch.tensor([-0.1, 0.2], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([2.0, 3.0], dtype=torch.float64, requires_grad=True)
    out = ArrayProgram({"out": ir.Where(ir.Predicate(X), op("mul", Y, 4.0), Y)})(
        {"x": x, "y": y}, TORCH, StraightThrough(5.0)
    )
    assert out["out"].tolist() == [2.0, 12.0]
    out["out"].sum().backward()
    assert y.grad.tolist() == [1.0, 4.0]
    slope = 2.5 * (1 - torch.tanh(5.0 * x.detach()) ** 2)
    torch.testing.assert_close(x.grad, slope * 3 * y.detach())


def test_gradient_of_a_distance_at_zero_is_zero() -> None:
    x = torch.zeros(2, requires_grad=True)
    y = torch.zeros(2, requires_grad=True)
    out = ArrayProgram({"a": op("norm", X, Y), "b": op("sqrt", op("add", op("square", X), op("square", Y)))})
    sum(value.sum() for value in out({"x": x, "y": y}, TORCH).values()).backward()
    assert x.grad.tolist() == [0, 0]


def test_constants_and_floats_in_the_environment() -> None:
    num = op("max", op("mul", ir.Signal("dt"), X), ir.Signal("t"))
    program = ArrayProgram({"out": num, "c": ir.Const(2.0)}, constants={"dt": 0.5})
    assert program.columns == {"x", "t"}
    out = program({"t": 1.0, "x": torch.tensor([0.0, 4.0])}, TORCH)
    assert out["out"].tolist() == [1.0, 2.0]
    assert out["c"].tolist() == [2.0, 2.0]


def test_functions_of_the_system() -> None:
    calls = []

    def turn(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        calls.append(1)
        return b, -a

    outputs = {"p": ir.Extern("turn", (X, Y), 0), "q": op("add", ir.Extern("turn", (X, Y), 1), 1.0)}
    out = ArrayProgram(outputs, externs={"turn": turn})({"x": np.ones(2), "y": np.full(2, 3.0)}, NUMPY)
    assert (out["p"].tolist(), out["q"].tolist(), len(calls)) == ([3, 3], [0, 0], 1)


def test_a_temporal_formula_is_no_condition() -> None:
    later = ir.Temporal("always", ir.Window(0, 1), ir.Predicate(X))
    with pytest.raises(TypeError, match="not a state formula"):
        ArrayProgram({"out": ir.Indicator(later)})


def test_division_by_zero_is_quiet() -> None:
    out = ArrayProgram({"out": op("div", X, op("sub", Y, Y))})({"x": np.ones(1), "y": np.ones(1)}, NUMPY)
    assert math.isinf(out["out"][0])


def test_large_recordings_are_computed_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Outputs are those of one pass: also constants, columns of two traces, and intervals."""
    monkeypatch.setattr("stlc.compile.backends.array.arith._ROOM", 50)
    env = {name: np.random.default_rng(i).normal(0, 1, (37, 2)) for i, name in enumerate(NAMES)}
    program = ArrayProgram(
        {"a": op("add", op("sin", X), op("mul", Y, Z)), "b": ir.Const(2.0), "c": op("abs", X)}
    )
    found = program(env, NUMPY)
    np.testing.assert_array_equal(found["a"], np.sin(env["x"]) + env["y"] * env["z"])
    assert (found["b"] == np.full((37, 2), 2.0)).all()
    boxes = program({name: Intervals(value, value + 1.0) for name, value in env.items()}, INTERVALS)
    assert boxes["c"].shape == (37, 2)
    assert ((boxes["c"].low <= found["c"]) & (found["c"] <= boxes["c"].high)).all()
    mixed = ArrayProgram({"a": op("add", X, Y)})({"x": env["x"], "y": env["y"][:1]}, NUMPY)
    np.testing.assert_array_equal(mixed["a"], env["x"] + env["y"][:1])
