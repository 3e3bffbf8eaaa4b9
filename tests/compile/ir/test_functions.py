"""The table of built-in functions: an entry says everything, and an entry is all that a function needs."""

from __future__ import annotations

import math
from types import MappingProxyType

import numpy as np
import pytest
import torch

from stlc.compile.analysis.ranges import bounds
from stlc.compile.backends.array import numpy_ops
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.numpy_ops import NUMPY, NumpyOps
from stlc.compile.backends.c.numbers import NumberWriter
from stlc.compile.backends.c.slopes import SlopeWriter
from stlc.compile.backends.torch.ops import TORCH, TorchOps
from stlc.compile.ir import functions
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, SHARED, Function

COMPUTED = [function for function in FUNCTIONS.values() if function.kind != "sampler"]
X = ir.Signal("x")


@pytest.mark.parametrize("function", COMPUTED, ids=lambda function: function.name)
class TestEveryEntryHasEverything:
    def test_it_has_a_value_and_a_range(self, function: Function) -> None:
        assert function.fold is not None
        assert function.bounds is not None
        assert function.doc or function.kind == "operator"

    def test_array_libraries_know_it(self, function: Function) -> None:
        assert function.array is not None or hasattr(NUMPY, function.name)
        assert function.array is not None or hasattr(TORCH, function.name)

    def test_it_has_a_form_in_c_with_a_derivative_by_every_argument(self, function: Function) -> None:
        arguments = [f"x{i}" for i in range(max(function.least, 2 if function.most is None else 1))]
        if function.of_each is not None:
            assert all(FUNCTIONS[name].slopes is not None for name in function.of_each)
            return
        assert function.c is not None
        assert function.c(*arguments)
        assert function.slopes is not None
        if function.slopes != SHARED and callable(function.slopes):
            assert len(function.slopes("r", *arguments)) == len(arguments)

    def test_values_lie_in_its_range(self, function: Function) -> None:
        number = max(function.least, 2 if function.most is None else 1)
        ends = [(0.25, 0.75), (0.5, 0.875), (0.75, 1.0)][:number]
        names = [f"x{i}" for i in range(number)]
        found = bounds(
            ir.Op(function.name, tuple(map(ir.Signal, names))), dict(zip(names, ends, strict=True))
        )
        assert found is not None
        assert function.fold is not None
        for share in (0.0, 0.3, 1.0):
            value = float(function.fold(*(low + share * (high - low) for low, high in ends)))
            assert found[0] - 1e-12 <= value <= found[1] + 1e-12


def test_an_entry_is_all_that_a_function_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    tanh = functions._smooth("tanh", "`tanh(x)`: the hyperbolic tangent.", "(1.0 - {r} * {r})", (-1.0, 1.0))
    table = MappingProxyType({**FUNCTIONS, "tanh": tanh})
    for module in (
        functions,
        numpy_ops,
        *map(__import__("sys").modules.__getitem__, (ArrayProgram.__module__, NumberWriter.__module__)),
        *map(__import__("sys").modules.__getitem__, (SlopeWriter.__module__, bounds.__module__)),
    ):
        monkeypatch.setattr(module, "FUNCTIONS", table)
    monkeypatch.setattr(NumpyOps, "tanh", staticmethod(np.tanh), raising=False)
    monkeypatch.setattr(TorchOps, "tanh", staticmethod(torch.tanh), raising=False)
    number = ir.Op("tanh", (X,))
    program = ArrayProgram({"y": number})
    assert "tanh" in functions.callable_names()
    assert program({"x": np.array([0.5])}, NUMPY)["y"] == pytest.approx(math.tanh(0.5))
    assert program({"x": torch.tensor([0.5])}, TORCH)["y"].item() == pytest.approx(math.tanh(0.5))
    assert bounds(number, {}) == (-1.0, 1.0)
    writer = SlopeWriter(lambda leaf: f"x[{leaf.name}]", soft=False)
    register = writer.number(number)
    assert any("tanh(" in line for line in writer.lines)
    lines, gathered = writer.backward({register: "1.0"})
    assert any(f"(1.0 - {register} * {register})" in line for line in lines)
    assert list(gathered) == ["gx[x]"]
