"""The table of built-in functions: an entry says everything, and an entry is all that a function needs."""

from __future__ import annotations

import math
from itertools import product
from types import MappingProxyType

import numpy as np
import pytest
import torch

from stlc.compile.backends.array import numpy_ops
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.numpy_ops import NUMPY, NumpyOps
from stlc.compile.backends.c.numbers import NumberWriter
from stlc.compile.backends.c.slopes import SlopeWriter
from stlc.compile.backends.torch.ops import TORCH, TorchOps
from stlc.compile.ir import functions
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, SHARED, Function
from stlc.compile.ir.ranges import bounds

COMPUTED = [function for function in FUNCTIONS.values() if function.kind != "sampler"]
X = ir.Signal("x")
ENDS = [(-2.0, -0.5), (-0.75, 0.25), (0.0, 1.0), (0.25, 0.75), (1.5, 3.0), (2.0, 2.0)]
COARSE = {"sin", "cos", "tan", "tanh", "atan2", "mod"}
"""Functions whose range in the table does not depend on all arguments."""


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

    def test_its_range_is_that_of_interval_arithmetic(self, function: Function) -> None:
        """Equality of two known ranges; that of a function in `COARSE` may be wider."""
        names = [f"x{i}" for i in range(max(function.least, 2 if function.most is None else 1))]
        cases = list(product(ENDS, repeat=len(names)))
        number = ir.Op(function.name, tuple(map(ir.Signal, names)))
        boxes = np.array(cases).transpose(1, 2, 0)
        env = {name: Intervals(*box) for name, box in zip(names, boxes, strict=True)}
        found = ArrayProgram({"y": number})(env, INTERVALS)["y"]
        compared = 0
        for case, low, high in zip(cases, found.low, found.high, strict=True):
            known = bounds(number, dict(zip(names, case, strict=True)))
            if known is not None and not math.isnan(low):
                compared += 1
                assert known[0] - 1e-9 <= low <= high <= known[1] + 1e-9
                assert function.name in COARSE or known == pytest.approx((low, high), abs=1e-9)
        assert compared >= len(cases) / 4


def test_an_entry_is_all_that_a_function_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    asinh = functions._smooth("asinh", "`asinh(x)`.", "(1.0 / sqrt(1.0 + {0} * {0}))", None, "arcsinh")
    table = MappingProxyType({**FUNCTIONS, "asinh": asinh})
    for module in (
        functions,
        numpy_ops,
        *map(__import__("sys").modules.__getitem__, (ArrayProgram.__module__, NumberWriter.__module__)),
        *map(__import__("sys").modules.__getitem__, (SlopeWriter.__module__, bounds.__module__)),
    ):
        monkeypatch.setattr(module, "FUNCTIONS", table)
    monkeypatch.setattr(NumpyOps, "asinh", staticmethod(np.arcsinh), raising=False)
    monkeypatch.setattr(TorchOps, "asinh", staticmethod(torch.asinh), raising=False)
    number = ir.Op("asinh", (X,))
    program = ArrayProgram({"y": number})
    assert "asinh" in functions.callable_names()
    assert program({"x": np.array([0.5])}, NUMPY)["y"] == pytest.approx(math.asinh(0.5))
    assert program({"x": torch.tensor([0.5])}, TORCH)["y"].item() == pytest.approx(math.asinh(0.5))
    assert bounds(number, {"x": (0.0, 1.0)}) == (0.0, math.asinh(1.0))
    writer = SlopeWriter(lambda leaf: f"x[{leaf.name}]", soft=False)
    register = writer.number(number)
    assert any("asinh(" in line for line in writer.lines)
    lines, gathered = writer.backward({register: "1.0"})
    assert any("(1.0 / sqrt(1.0 +" in line for line in lines)
    assert list(gathered) == ["gx[x]"]


@pytest.mark.parametrize("name", ["tanh", "sinh", "cosh", "log10"])
def test_slopes_of_smooth_functions_are_those_of_torch(name: str) -> None:
    function = FUNCTIONS[name]
    at = torch.tensor([0.25, 0.5, 2.0], dtype=torch.float64, requires_grad=True)
    result = ArrayProgram({"y": ir.Op(name, (X,))})({"x": at}, TORCH)["y"]
    result.sum().backward()
    assert callable(function.slopes)
    assert at.grad is not None
    for x, r, wanted in zip(at.tolist(), result.tolist(), at.grad.tolist(), strict=True):
        (text,) = function.slopes(repr(r), repr(x))
        assert eval(text, vars(math)) == pytest.approx(wanted, rel=1e-12)


def test_the_range_of_a_catenary_turns_at_0() -> None:
    number = ir.Op("cosh", (X,))
    assert bounds(number, {"x": (-2.0, 1.0)}) == (1.0, math.cosh(2.0))
    assert bounds(number, {"x": (-2.0, -1.0)}) == (math.cosh(1.0), math.cosh(2.0))
