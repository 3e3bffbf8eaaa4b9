"""A policy's network as a graph: what is observed, the layers, plans within the ranges of the controls."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from torch import nn

from stlc.compile.backends.onnx.ops import ONNX_OPS as ONNX
from stlc.compile.backends.onnx.sheet import BATCH, Value, joined
from stlc.compile.ir import nodes as ir
from stlc.dynamics.model.controls import EPS, raw_width
from stlc.export.onnx_rollout import assigned

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from torch import Tensor

    from stlc.controller.policies.policy import PlanNetwork
    from stlc.controller.problem.task import Task
    from stlc.dynamics.declaration.columns import ControlDecl


def proposed(task: Task, network: PlanNetwork, state: Mapping[str, Value]) -> Value:
    """All plans of a network.

    Args:
        task: that it was trained for.
        network: in float32, as it was trained.
        state: (1, batch) each.

    Returns:
        (batch, plans, T, m) float64.

    Raises:
        Untranslatable: what is observed or mirrored calls a function of Python.
    """
    folded, swapped = _folded(task, network, state)
    raw = _layers(network, _observed(task, folded))
    raw = raw.reshaped(BATCH, network.plans, task.horizon, raw_width(task.system.controls))
    columns = iter(raw.transposed(3, 0, 1, 2).rows())
    controls = {each.name: _squashed(each, columns) for each in task.system.controls}
    if swapped is not None:
        mask = swapped.reshaped(1, BATCH, 1, 1)
        images = _images(task, controls)
        controls = {name: ONNX.where(mask, images[name], value) for name, value in controls.items()}
    return joined(list(controls.values())).transposed(1, 2, 3, 0).cast("float64")


def _folded(
    task: Task, network: PlanNetwork, state: Mapping[str, Value]
) -> tuple[Mapping[str, Value], Value | None]:
    """States on the side of the mirror that the network knows, and which of them are images."""
    if network.mirror is None:
        return state, None
    names = set(task.names)
    images = [each for each in task.system.decl.policy.mirror if each.name in names]
    moved = assigned({each.name: each.value for each in images}, state)
    side = task.names[network.mirror.side]
    swapped = ONNX.gt(moved[side], state[side])
    folded = {name: ONNX.where(swapped, moved[name], state[name]) for name in moved}
    return {**state, **folded}, swapped


def _observed(task: Task, state: Mapping[str, Value]) -> Value:
    """What the network sees, (batch, k) float32."""
    system = task.system
    numbers: list[ir.Num] = [*system.decl.policy.observe, *(ir.Signal(each.name) for each in system.added)]
    if not system.decl.policy.observe:
        numbers = [ir.Signal(name) for name in system.names]
    seen = assigned({str(place): number for place, number in enumerate(numbers)}, state)
    like = next(iter(state.values()))
    rows = [seen[str(place)].spread(1, BATCH, like=like) for place in range(len(numbers))]
    return joined(rows).T.cast("float32")


def _layers(network: PlanNetwork, seen: Value) -> Value:
    sheet = seen.sheet
    x = (seen - _weights(seen, network.centre)) / _weights(seen, network.spread)
    for layer in network.body:
        if isinstance(layer, nn.Linear):
            parts = (x, _weights(seen, layer.weight), _weights(seen, layer.bias))
            (x,) = sheet.emit("Gemm", parts, [(BATCH, layer.out_features)], "float32", {"transB": 1})
        else:
            x = x.apply("Relu")
    return x


def _weights(like: Value, tensor: Tensor) -> Value:
    return like.sheet.constant(tensor.detach().numpy(force=True), "float32")


def _squashed(control: ControlDecl, columns: Iterator[Value]) -> Value:
    """One control in physical units, from one column of the network or two."""
    first = next(columns)
    match control.squash:
        case "tanh":
            unit = first.apply("Tanh")
        case "clip":
            unit = ONNX.clamp(first, -1.0, 1.0)
        case "angle":
            unit = ONNX.atan2(next(columns), first + EPS) / math.pi
    scaled: Value = unit * ((control.high - control.low) / 2) + (control.low + control.high) / 2
    return scaled


def _images(task: Task, controls: Mapping[str, Value]) -> dict[str, Value]:
    """The mirror images of controls; angles stay within a turn of their range."""
    names = set(task.names)
    images = [each for each in task.system.decl.policy.mirror if each.name not in names]
    moved = {**controls, **assigned({each.name: each.value for each in images}, controls)}
    for each in task.system.controls:
        if each.squash == "angle":
            moved[each.name] = ONNX.mod(moved[each.name] - each.low, 2.0 * math.pi) + each.low
    return moved
