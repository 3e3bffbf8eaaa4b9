"""Every formula as a graph equals the array evaluator, `freeze` and the past too."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.emitted import STEPS, assert_every_kind, planned_formulas, traces_of
from helpers.formula_strategies import NAMES
from helpers.onnx_graphs import columns_on, computed

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.backends.onnx.graph import OnnxGraph
from stlc.compile.backends.onnx.ops import build_graph
from stlc.compile.ir import nodes as ir

X, Y, Z = (ir.Predicate(ir.Signal(name)) for name in NAMES)


def _agree(rules: list[ir.Formula], trace: np.ndarray, count: int = 1) -> None:
    env = {name: trace[:, :, i].copy() for i, name in enumerate(NAMES)}
    values = build_graph(rules, columns_on(OnnxGraph(), NAMES, STEPS + 1), count=count)
    found = computed({f"r{i}": value for i, value in enumerate(values)}, env)
    expected = evaluate(rules, env, ops=NUMPY, count=count)
    for value, wanted in zip(found.values(), expected, strict=True):
        np.testing.assert_allclose(np.broadcast_to(value, wanted.shape), wanted, rtol=1e-12, atol=1e-12)


def test_random_formulas_equal_the_evaluator() -> None:
    rules = planned_formulas(60)
    assert_every_kind(rules)
    _agree(rules, np.round(traces_of(1, 40) * 8) / 8)


@pytest.mark.slow
def test_a_thousand_random_formulas() -> None:
    rules = planned_formulas(1200)
    for seed, first in enumerate(range(0, len(rules), 60)):
        _agree(rules[first : first + 60], np.round(traces_of(seed, 30) * 8) / 8)


def test_several_instants_and_the_mission_clock() -> None:
    start = ir.AtStart(ir.Temporal("eventually", ir.Window(0, 3), X))
    rules = [ir.BoolOp("or", (start, Y)), ir.Until("until", ir.Window(2, 5), X, Z), ir.Truth(value=True)]
    _agree(rules, traces_of(4, 30), count=4)


@pytest.mark.parametrize(
    "rule",
    [
        ir.Predicate(ir.Extern("f", (ir.Signal("x"),))),
        ir.Predicate(
            ir.Op("add", (ir.Const(1.0), ir.Extern("f", (ir.Signal("x"),), function=lambda x: (x,))))
        ),
        ir.Predicate(ir.ShiftedSignal("x", STEPS + 1)),
        ir.Temporal("always", ir.Window(0, STEPS + 1), X),
    ],
)
def test_what_has_no_form_is_said(rule: ir.Formula) -> None:
    with pytest.raises(Untranslatable):
        build_graph([rule], columns_on(OnnxGraph(), NAMES, STEPS + 1))
