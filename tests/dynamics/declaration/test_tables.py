"""Interpolation tables: their values, derivatives and units."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

import stlc
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.controller.problem.task import Task
from stlc.diagnostics import StlcError
from stlc.dynamics.declaration.tables import TableDecl, body
from stlc.dynamics.system import System
from stlc.units import Unit

Make = Callable[..., System]
PLANT = (
    "time: {dt: 0.1 s, horizon: 10 steps}\n"
    "state: {x: {unit: m}, y: {unit: m/s}}\n"
    "init: {mixture: [{draw: {x: 'uniform(-2, 4)', y: 'uniform(-1, 3)'}}]}\n"
)
POINTS = st.lists(st.integers(-40, 40), min_size=2, max_size=6, unique=True).map(
    lambda numbers: tuple(number / 4 for number in sorted(numbers))
)


def table(points: tuple[tuple[float, ...], ...], extrapolate: str, seed: int = 0) -> TableDecl:
    """A table of random values."""
    shape = [len(row) for row in points]
    values = np.random.default_rng(seed).normal(size=[1, *shape][-2:])
    rows = tuple(map(tuple, values.tolist()))
    return TableDecl("f", (Unit(),) * len(points), Unit(), points, rows, extrapolate)  # type: ignore[arg-type]


def program(decl: TableDecl) -> ArrayProgram:
    """The table as a function of signals `at0`, `at1`."""
    signals = tuple(ir.Signal(f"at{i}") for i in range(len(decl.points)))
    return ArrayProgram(
        {"f": ir.Extern("f", signals, 0, body(decl, [list(map(ir.Const, row)) for row in decl.values]))}
    )


@settings(max_examples=24, deadline=None)
@given(st.lists(POINTS, min_size=1, max_size=2), st.sampled_from(("linear", "hold")), st.integers(0, 99))
def test_values_are_what_scipy_interpolates(
    points: list[tuple[float, ...]], extrapolate: str, seed: int
) -> None:
    decl = table(tuple(points), extrapolate, seed)
    rng = np.random.default_rng(seed)
    at = [np.concatenate((rng.uniform(-15, 15, 40), rng.choice(row, 10))) for row in points]
    found = program(decl)({f"at{i}": each for i, each in enumerate(at)}, NUMPY)["f"]
    values = np.array(decl.values)
    wanted = RegularGridInterpolator(
        points, values[0] if len(points) == 1 else values, bounds_error=False, fill_value=None
    )
    if extrapolate == "hold":
        at = [np.clip(each, row[0], row[-1]) for each, row in zip(at, points, strict=True)]
    np.testing.assert_allclose(found, wanted(np.stack(at, 1)), atol=1e-9 * (1 + np.abs(found).max()))


def test_derivatives_are_those_of_the_cells() -> None:
    decl = table(((0.0, 1.0, 3.0), (0.0, 2.0, 5.0)), "linear")
    at = torch.tensor([[-0.5, 0.5, 2.0, 4.0], [1.0, 3.0, 6.0, -1.0]], dtype=torch.float64, requires_grad=True)
    program(decl)({"at0": at[0], "at1": at[1]}, TORCH)["f"].sum().backward()
    v = np.array(decl.values)
    assert at.grad is not None
    wanted = (v[1, 0] + v[1, 1] - v[0, 0] - v[0, 1]) / 2  # in the middle of the cell's first edge
    assert at.grad[0, 0].item() == pytest.approx(wanted)
    share = (2.0 - 1.0) / 2.0
    below, above = (1 - share) * v[1] + share * v[2], 3.0
    assert at.grad[1, 2].item() == pytest.approx((below[2] - below[1]) / above)


def test_long_tables_are_no_deep_expressions() -> None:
    decl = table((tuple(float(i) for i in range(1000)),), "linear")
    found = program(decl)({"at0": np.array([500.5])}, NUMPY)["f"]
    assert found == pytest.approx((decl.values[0][500] + decl.values[0][501]) / 2)


def test_tables_in_a_system_in_torch_and_c(make: Make) -> None:
    system = make(
        PLANT + "table:\n"
        "  pull:\n    of: {x: km, y: m/s}\n    unit: km/h\n"
        "    at: [[0, 0.001, 2 m], [0, 1]]\n    values: [[0, 3.6], [3.6, 0], [0, 0]]\n"
        "  lift: {of: [a], at: [0, 1, 2], values: [0, 1, 4], extrapolate: hold}\n"
        "flow: {x: 'pull(x, y)', y: lift(x / 1 m)}\n"
    )
    first, second = system.decl.tables
    assert first.points == ((0.0, 0.001, 0.002), (0.0, 1.0))
    assert second.extrapolate == "hold"
    x0 = system.sample(20, seed=0, dtype=torch.float64)
    u = torch.zeros(20, 10, 0, dtype=torch.float64)
    after = system.step(x0, u[:, 0])
    x, y = x0[:, 0].numpy(), x0[:, 1].numpy()
    lift = np.interp(x, [0, 1, 2], [0, 1, 4])
    np.testing.assert_allclose(after[:, 1], y + 0.1 * lift, atol=1e-12)
    pull = RegularGridInterpolator(
        ([0, 1, 2], [0, 1]), [[0, 1], [1, 0], [0, 0]], bounds_error=False, fill_value=None
    )
    np.testing.assert_allclose(after[:, 0], x + 0.1 * pull(np.stack((x, y), 1)), atol=1e-12)
    task = Task.of(stlc.parse("state signal x [m]\nrequire r: always x < 1 m"), system)
    assert task.native is not None
    torch.testing.assert_close(
        task.judge(x0, u).requirements, task._judged_by_torch(x0, u)[0], atol=1e-12, rtol=0
    )


def test_other_values_are_another_thing_to_learn(make: Make) -> None:
    text = PLANT + "table: {f: {of: [a], at: [0, 1], values: [0, 1]}}\nflow: {x: f(x / 1 m)}\n"
    assert make(text).decl.learnt != make(text.replace("[0, 1]}}", "[0, 2]}}")).decl.learnt


@pytest.mark.parametrize(
    ("keys", "code"),
    [
        ("of: [a], at: [0, 1], values: [0, 1, 2]", "S204"),
        ("of: [a], at: [0], values: [0]", "S204"),
        ("of: [a], at: [1, 0], values: [0, 1]", "S204"),
        ("of: [a, b], at: [0, 1], values: [0, 1]", "S103"),
        ("of: [a, b], at: [[0, 1], [0, 1]], values: [[0, 1]]", "S204"),
        ("of: [a, b, c], at: [[0, 1], [0, 1]], values: [[0, 1], [0, 1]]", "S103"),
        ("of: {a: degC}, at: [0, 1], values: [0, 1]", "S103"),
        ("of: {a: m}, at: [0 s, 1], values: [0, 1]", "E203"),
        ("of: [a], at: [0, x], values: [0, 1]", "S103"),
        ("of: [a], at: [0, 1]", "S102"),
        ("of: {a: s}, at: [0, 1], values: [0, 1]", "E203"),
        ("of: [a, b], at: [[0, 1], [0, 1]], values: [[0, 1], [0, 1]]", "E105"),
    ],
)
def test_wrong_declarations(make: Make, keys: str, code: str) -> None:
    with pytest.raises(StlcError) as error:
        make(PLANT + f"table: {{f: {{{keys}}}}}\nflow: {{x: f(x)}}\n")
    assert code in [finding.code for finding in error.value.diagnostics]
