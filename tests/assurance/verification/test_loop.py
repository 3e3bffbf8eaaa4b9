"""Closed loops with a network: bounds, exact solutions, networks in ONNX, and what is refused."""

from __future__ import annotations

import json
import random
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.small_policies import half_seen_task
from helpers.small_systems import moved_by_steps

from stlc.assurance.verification.boxes import Box
from stlc.assurance.verification.forms import Forms
from stlc.assurance.verification.loop import NetworkLoop
from stlc.assurance.verification.network import NetworkBounds, NetworkLayer
from stlc.assurance.verification.onnx_layers import read_onnx
from stlc.assurance.verification.verify import Verifier
from stlc.cli.framework.app import main
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError

ROOT = Path(__file__).parents[3]
SPEC = str(ROOT / "examples" / "ainncs" / "single_pendulum.stl")


def random_layers(kind: str, inputs: int = 2, outputs: int = 1) -> list[NetworkLayer]:
    """Layers of a small random network, whose last layer is linear."""
    rng = np.random.default_rng(7)
    hidden = NetworkLayer(rng.normal(size=(8, inputs)), rng.normal(size=8), kind)
    return [hidden, NetworkLayer(0.2 * rng.normal(size=(outputs, 8)), rng.normal(size=outputs))]


@cache
def loop(kind: str, period: int = 2, *, continuous: bool = False, substeps: int = 1) -> NetworkLoop:
    task = Task.load(SPEC, overrides={"time.substeps": str(substeps)})
    return NetworkLoop(task, random_layers(kind), period, continuous=continuous)


@pytest.mark.parametrize("kind", ["relu", "tanh", "sigmoid"])
@pytest.mark.parametrize("continuous", [False, pytest.param(True, marks=pytest.mark.apart)])
def test_bounds_contain_the_simulated_robustness(kind: str, continuous: bool) -> None:
    found = loop(kind, continuous=continuous)
    exact = loop(kind, substeps=40) if continuous else found
    rng, mode = np.random.default_rng(1), found.modes[0]
    centre = rng.uniform(0.05, 0.95, (30, 2))
    half = 10.0 ** rng.uniform(-3, -1.3, (30, 2))
    bounds = found.bound(mode, [Box(*each) for each in zip(centre, half, strict=True)], 0)
    assert np.isfinite(bounds.low).sum() > 20
    for _ in range(5):
        at = np.clip(centre + rng.choice([-1.0, 1.0, 0.3], centre.shape) * half, 0, 1)
        rho = exact.robustness(exact.states(mode, at))
        assert (bounds.low <= rho + 1e-7).all()
        assert (bounds.high >= rho - 1e-7).all()


def test_the_network_acts_once_per_period() -> None:
    states = loop("tanh", 2).simulated(loop("tanh", 2).states(loop("tanh").modes[0], np.array([[0.5, 0.5]])))
    other = loop("tanh", 1).simulated(states[:, 0])
    np.testing.assert_allclose(states[:, 1], other[:, 1])
    assert float((states[:, 2] - other[:, 2]).abs().max()) > 1e-6


@pytest.mark.parametrize("kind", ["relu", "tanh", "sigmoid"])
def test_outputs_of_a_network_stay_within_their_forms(kind: str) -> None:
    layers, rng = random_layers(kind, 3, 2), np.random.default_rng(3)
    centre, generators = rng.normal(size=(5, 3)), 0.3 * rng.normal(size=(4, 5, 3))
    found = NetworkBounds(layers).outputs(Forms(centre, generators, np.zeros((5, 3))))
    bound = found.range
    for _ in range(50):
        x = centre + np.tensordot(rng.uniform(-1, 1, 4), generators, 1)
        first = x @ layers[0].weight.T + layers[0].bias
        hidden = {
            "relu": np.maximum(first, 0),
            "tanh": np.tanh(first),
            "sigmoid": 1 / (1 + np.exp(-first)),
        }[kind]
        exact = hidden @ layers[1].weight.T + layers[1].bias
        assert ((bound.low <= exact) & (exact <= bound.high)).all()


def test_sampled_states_of_proved_boxes_satisfy_the_specification() -> None:
    subject = NetworkLoop(Task.load(SPEC), [NetworkLayer(np.array([[-2.0, -1.0]]), np.zeros(1))])
    result = Verifier(subject, seed=2).run(1e6, boxes=200).modes[0]
    assert result.proved > 0.3
    rng = np.random.default_rng(6)
    for box in result.boxes[:10]:
        at = box.centre + rng.uniform(-1, 1, (100, 2)) * box.half
        assert (subject.robustness(subject.states(result.mode, at)) >= -1e-6).all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_states_that_the_network_does_not_see_keep_their_symbols(tmp_path: Path, sign: float) -> None:
    sizes = NetworkLayer(np.array([[1.0], [-1.0]]), np.zeros(2), "relu")
    last = NetworkLayer(np.array([[-sign, -sign]]), np.array([0.5 * sign]))  # 0.5 - |y| or the negative
    found = NetworkLoop(half_seen_task(tmp_path), [sizes, last])
    mode, whole = found.modes[0], Box(np.full(2, 0.5), np.full(2, 0.5))
    bounds = found.bound(mode, [whole], 0)
    rho = found.robustness(found.states(mode, np.random.default_rng(0).random((1000, 2))))
    assert bounds.low[0] <= rho.min() < -0.2
    assert bounds.high[0] >= rho.max()
    assert Verifier(found, seed=0).run(1e6, boxes=50).refuted > 0.0


# ---------------------------------------------------------------------------------- networks


def written(
    path: Path, layers: list[NetworkLayer], scale: float = 1.0, *, cast: int = 1, transposed: int = 0
) -> Path:
    """Write a network with Gemm, MatMul, Add, an activation and a cast; inputs are multiplied by `scale`."""
    onnx = pytest.importorskip("onnx")
    helper, arrays = onnx.helper, onnx.numpy_helper

    def constant(value: Any, name: str) -> Any:
        return arrays.from_array(np.asarray(value, dtype=np.float32), name)

    first, last = layers
    nodes = [
        helper.make_node("Mul", ["x", "scale"], ["s"]),
        helper.make_node("Gemm", ["s", "W", "b"], ["h"], transA=transposed, transB=1),
        helper.make_node(first.activation.capitalize(), ["h"], ["a"]),
        helper.make_node("MatMul", ["a", "V"], ["m"]),
        helper.make_node("Add", ["m", "c"], ["y"]),
        helper.make_node("Cast", ["y"], ["u"], to=cast),
    ]
    values = [
        constant([scale], "scale"),
        constant(first.weight, "W"),
        constant(first.bias, "b"),
        constant(last.weight.T, "V"),
        constant(last.bias, "c"),
    ]
    real = onnx.TensorProto.FLOAT
    ports = (
        [helper.make_tensor_value_info("x", real, [1, first.weight.shape[1]])],
        [helper.make_tensor_value_info("u", real, [1, len(last.bias)])],
    )
    graph = helper.make_graph(nodes, "network", *ports, values)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return path


def test_layers_of_a_file_in_onnx(tmp_path: Path) -> None:
    layers = random_layers("tanh")
    first, last = read_onnx(written(tmp_path / "net.onnx", layers, 2.0))
    np.testing.assert_allclose(first.weight, 2.0 * layers[0].weight, rtol=1e-6)
    np.testing.assert_allclose(first.bias, layers[0].bias, rtol=1e-6)
    np.testing.assert_allclose(last.weight, layers[1].weight, rtol=1e-6)
    assert (first.activation, last.activation) == ("tanh", "linear")


def test_a_closed_loop_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(written(tmp_path / "net.onnx", random_layers("tanh")))
    arguments = ["verify", SPEC, "--controller", path, "--boxes", "64"]
    assert main([*arguments, "--period", "0.1s", "--continuous"]) in (0, 1, 4)
    assert "initial set" in capsys.readouterr().out
    assert main([*arguments, "--period", "0.07s"]) == 2
    assert "not a multiple of the time step" in capsys.readouterr().err
    assert main(["verify", "latest", "--period", "0.1s"]) == 2


def test_ways_to_draw_a_state_may_have_equal_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    system = moved_by_steps("two_places", "choice(uniform(0, 1), uniform(5, 6))")
    (tmp_path / "two_places.yaml").write_text(system)
    spec = tmp_path / "two_places.stl"
    spec.write_text('system "two_places.yaml"\nsignal x\nrequire r: always[0 s, 1 s] x > 3\n')
    still = [NetworkLayer(np.zeros((1, 1)), np.zeros(1), "tanh"), NetworkLayer(np.zeros((1, 1)), np.zeros(1))]
    arguments = ["--controller", str(written(tmp_path / "net.onnx", still)), "--boxes", "5"]
    assert main(["verify", str(spec), *arguments, "--states", "40", "--json"]) == 1
    result = json.loads(capsys.readouterr().out)["result"]
    low, high = result["modes"]
    assert low["name"] == high["name"]
    assert 0 < low["states"] == low["states_violated"]
    assert 0 < high["states"] == high["states_proved"]
    assert result["states"] == low["states"] + high["states"] == 40


def test_files_that_are_no_network_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    (tmp_path / "net.onnx").write_bytes(b"\x08\x07no network")
    with pytest.raises(UsageError, match=r"not a network|one input"):
        read_onnx(tmp_path / "net.onnx")
    with pytest.raises(UsageError, match="not a network"):
        read_onnx(tmp_path / "absent.onnx")


@pytest.mark.parametrize("count", [200, pytest.param(3000, marks=pytest.mark.slow)])
def test_damaged_networks_are_refused_or_read(count: int, tmp_path: Path) -> None:
    whole = written(tmp_path / "whole.onnx", random_layers("relu")).read_bytes()
    path, refused = tmp_path / "net.onnx", 0
    for seed in range(count):
        rng, data = random.Random(seed), bytearray(whole)
        for _ in range(rng.choice((1, 1, 5, 50))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data[: rng.randrange(len(data))] if rng.random() < 0.2 else data)
        try:
            layers = read_onnx(path)
        except UsageError:
            refused += 1
        else:
            assert all(np.isfinite(each.weight).all() and np.isfinite(each.bias).all() for each in layers)
    assert refused > count / 10


@pytest.mark.parametrize("options", [{"cast": 7}, {"cast": 10}, {"transposed": 1}])
def test_operations_that_are_no_linear_map_are_refused(tmp_path: Path, options: dict[str, int]) -> None:
    path = written(tmp_path / "net.onnx", random_layers("relu"), **options)  # to int64, to float16, transA
    with pytest.raises(UsageError, match=r"not supported: (Cast|Gemm)"):
        read_onnx(path)


def test_a_network_of_other_sizes_is_refused() -> None:
    with pytest.raises(UsageError, match="takes 3 numbers"):
        NetworkLoop(Task.load(SPEC), random_layers("relu", inputs=3))


def test_solutions_of_a_system_with_jumps_are_refused() -> None:
    task = Task.load(ROOT / "specs" / "traffic.stl")
    with pytest.raises(UsageError, match="cannot be bounded"):
        NetworkLoop(task, random_layers("relu", inputs=7), continuous=True)
