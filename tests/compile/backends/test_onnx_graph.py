"""A graph computes as NumPy does, equal operations once."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.onnx_graphs import computed

from stlc.compile.backends.onnx import ops
from stlc.compile.backends.onnx.graph import BATCH, OnnxGraph, joined
from stlc.compile.backends.onnx.ops import ONNX

ARRAY = np.arange(15.0).reshape(5, 3) - 4.0


def test_cutting_and_shaping_is_that_of_numpy() -> None:
    x = OnnxGraph().input("x", (5, BATCH))
    wide = x[:1].expand(4, BATCH)
    outputs = {
        "slice": x[1:4],
        "back": x[::-1],
        "row": x[-2],
        "whole": x[:],
        "moved": x.T,
        "parts": joined([row + 1.0 for row in x.rows()]),
        "shaped": x.reshaped(1, 5, BATCH),
        "wide": wide * 2.0,
        "sums": 1.0 - x * 3.0 / 2.0 + (-x),
        "inverse": 2.0 / (x + 0.5),
        "constant": x.graph.constant([[7.0], [8.0]]).expand(2, BATCH, like=x),
    }
    found = computed(outputs, {"x": ARRAY})
    expected = {
        "slice": ARRAY[1:4],
        "back": ARRAY[::-1],
        "row": ARRAY[-2],
        "whole": ARRAY,
        "moved": ARRAY.T,
        "parts": ARRAY + 1.0,
        "shaped": ARRAY[None],
        "wide": np.repeat(ARRAY[:1], 4, 0) * 2.0,
        "sums": 1.0 - ARRAY * 1.5 - ARRAY,
        "inverse": 2.0 / (ARRAY + 0.5),
        "constant": np.repeat([[7.0], [8.0]], 3, 1),
    }
    for name, wanted in expected.items():
        np.testing.assert_array_equal(found[name], wanted, err_msg=name)
        declared = outputs[name].shape
        assert [a for a in declared if a != BATCH] == [
            a for a, known in zip(wanted.shape, declared, strict=True) if known != BATCH
        ], name


def test_equal_operations_are_one_node_and_unused_ones_none() -> None:
    x = OnnxGraph().input("x", (5, BATCH))
    first, second = x + 1.0, x + 1.0
    assert first is second
    unused = x * 2.0
    assert [node.op for node in x.graph.needed((first * first,))] == ["Add", "Mul"]
    assert unused.graph is x.graph


def test_shapes_that_do_not_fit_are_not_written() -> None:
    graph = OnnxGraph()
    with pytest.raises(AssertionError, match="5"):
        graph.input("x", (5, BATCH)) + graph.input("y", (4, BATCH))


@pytest.mark.parametrize("written_out", [True, False])
def test_a_loop_is_the_same_written_out_and_as_a_node(
    written_out: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ops, "UNROLLED_NODES", 10**9 if written_out else 0)
    graph = OnnxGraph()
    x, first = graph.input("x", (5, BATCH)), graph.input("first", (1, BATCH))
    factor, unread = first * 0.5, first + 9.0

    def body(now, rows):
        total = now[0] + rows[0] * rows[1]
        return [total, now[0]], [total * 2.0, rows[1], now[1]]

    doubled, same, before = map(joined, ONNX.scan(body, [first, first], [x, factor], 5))
    scans = [node for node in graph.needed([doubled]) if node.op == "Scan"]
    assert bool(scans) != written_out
    assert unread.name not in {name for node in graph.needed([doubled]) for name in node.outputs}
    begin = np.array([[1.0, 2.0, -4.0]])
    found = computed({"doubled": doubled, "same": same, "before": before}, {"x": ARRAY, "first": begin})
    totals = begin + np.cumsum(ARRAY * begin * 0.5, 0)
    np.testing.assert_array_equal(found["doubled"], totals * 2.0)
    np.testing.assert_array_equal(found["same"], np.repeat(begin * 0.5, 5, 0))
    np.testing.assert_array_equal(found["before"], np.concatenate([begin, begin, totals[:3]]))
