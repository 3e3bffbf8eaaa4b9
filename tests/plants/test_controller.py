"""Networks in the loop: what they read and write, and when."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from helpers.plants import FILE, changed, pendulum, read, simulated

from stlc.plants.kind import FaultError, UnfitError

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


@pytest.fixture(autouse=True)
def _own_path(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))


def linear(path, gain, bias, shape, kind=None):
    """Write the network `gain x + bias`."""
    from onnx import TensorProto, helper, numpy_helper

    kind = kind or TensorProto.FLOAT
    numbers = np.float32 if kind == TensorProto.FLOAT else np.float64
    weights = [
        numpy_helper.from_array(np.array(gain, dtype=numbers).T, "w"),
        numpy_helper.from_array(np.array(bias, dtype=numbers), "b"),
    ]
    nodes = [helper.make_node("MatMul", ["x", "w"], ["p"]), helper.make_node("Add", ["p", "b"], ["y"])]
    given = helper.make_tensor_value_info("x", kind, shape)
    made = helper.make_tensor_value_info("y", kind, None)
    graph = helper.make_graph(nodes, "net", [given], [made], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path))


def looped(
    folder, controller, inputs="{torque: {range: [-10, 10]}, wind: {range: [0, 1]}}", u=None, **changes
):
    pendulum(folder)
    text = changed(
        FILE,
        python='"pendulum.py:flow"',
        input=inputs,
        controller=controller,
        output="{angle: , rate: }",
        **changes,
    )
    decl = read(text, folder)
    order = [each.name for each in decl.inputs]
    if order[0] == "wind":  # the flow reads the first input: make that the written one
        (folder / "pendulum.py").write_text((folder / "pendulum.py").read_text().replace("+ u[0]", "+ u[1]"))
    wind = np.zeros((decl.steps, len(decl.free))) if u is None else u
    return simulated(decl, folder, {"angle": 0.5, "length": 1.0}, wind)


NET = "{onnx: net.onnx, reads: [angle, rate], writes: [torque]"


@pytest.mark.parametrize("shape", [[1, 2], ["batch", 2], [None, 2], ["n"], [2]])
def test_a_command_is_what_the_network_gives(tmp_path, shape):
    linear(tmp_path / "net.onnx", [[-3.0, -1.5]], [0.25], shape)
    found = looped(tmp_path, NET + "}")
    y, w = found[:-1, :2], found[1:, 2]
    assert w == pytest.approx(-3.0 * y[:, 0] - 1.5 * y[:, 1] + 0.25, abs=1e-5)


def test_a_command_is_held_for_a_period(tmp_path):
    linear(tmp_path / "net.onnx", [[-3.0, -1.5]], [0.0], [1, 2])
    found = looped(tmp_path, NET + ", period: 50 ms}")
    y, w = found[:-1, :2], found[1:, 2]
    for start in range(0, 100, 5):
        assert w[start] == pytest.approx(-3.0 * y[start, 0] - 1.5 * y[start, 1], abs=1e-5)
        assert (w[start : start + 5] == w[start]).all()
    assert len(set(w)) == 20


def test_a_command_is_scaled_shifted_and_limited(tmp_path):
    linear(tmp_path / "net.onnx", [[1.0, 0.0]], [0.0], [1, 2])
    found = looped(tmp_path, NET + ", scale: 4, offset: -1}", inputs="{torque: {range: [-2, 0.5]}, wind: 0}")
    y, w = found[:-1, 0], found[1:, 2]
    assert w == pytest.approx(np.clip(4 * y - 1, -2, 0.5), abs=1e-5)
    assert {-2, 0.5} <= set(w)


def test_a_network_reads_inputs_and_parameters(tmp_path):
    linear(tmp_path / "net.onnx", [[1.0, 10.0]], [0.0], [1, 2])
    wind = np.linspace(0, 1, 100)[:, None]
    found = looped(
        tmp_path,
        "{onnx: net.onnx, reads: [wind, length], writes: [torque]}",
        inputs="{torque: {unit: rad/s^2}, wind: {range: [0, 1]}}",
        u=wind,
    )
    assert found[1:, 2] == pytest.approx(wind[:, 0] + 10.0, abs=1e-5)


@pytest.mark.parametrize(
    ("shape", "gain", "place"),
    [([1, 3], [[1.0, 1.0, 1.0]], "controller.reads"), ([], [[1.0]], "controller.reads")],
)
def test_a_network_of_another_size_is_refused(tmp_path, shape, gain, place):
    if shape:
        linear(tmp_path / "net.onnx", gain, [0.0], shape)
        with pytest.raises(UnfitError, match="`reads` names 2") as caught:
            looped(tmp_path, NET + "}")
        assert caught.value.place == place
    else:
        (tmp_path / "net.onnx").write_bytes(b"no network")
        with pytest.raises(UnfitError, match="cannot be read"):
            looped(tmp_path, NET + "}")


def test_too_many_commands_are_a_fault(tmp_path):
    linear(tmp_path / "net.onnx", [[1.0, 1.0], [1.0, 1.0]], [0.0, 0.0], [1, 2])
    with pytest.raises(FaultError, match="gives 2 numbers") as caught:
        looped(tmp_path, NET + "}")
    assert caught.value.reason == "wrong shape"


def test_a_command_that_is_no_number_is_a_fault(tmp_path):
    linear(tmp_path / "net.onnx", [[np.inf, 0.0]], [-np.inf], [1, 2])
    with pytest.raises(FaultError) as caught:
        looped(tmp_path, NET + "}")
    assert caught.value.reason == "not finite"


def test_double_precision_networks_are_read(tmp_path):
    linear(tmp_path / "net.onnx", [[-1.0, 0.0]], [0.0], [1, 2], kind=onnx.TensorProto.DOUBLE)
    found = looped(tmp_path, NET + "}")
    assert found[1:, 2] == pytest.approx(-found[:-1, 0], abs=1e-15)
