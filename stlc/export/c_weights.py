"""The weights of a policy as C arrays, and its layers as calls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from torch import nn

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.policies.policy import PlanNetwork


def weights(network: PlanNetwork) -> str:
    """`centre` and `scale` of what is observed, and a `weight_0` (in, out) and a `bias_0` per layer."""
    lines = ["/* float32, row by row; generated */"]
    lines += [f"static const float centre[] = {{{_row(network.centre)}}};"]
    lines += [f"static const float spread[] = {{{_row(network.spread)}}};"]
    for number, layer in enumerate(_layers(network)):
        rows = ",\n".join(f"{{{_row(row)}}}" for row in layer.weight.detach().t())
        lines.append(
            f"static const float weight_{number}[{layer.in_features}][{layer.out_features}] = {{\n{rows}}};"
        )
        lines.append(f"static const float bias_{number}[{layer.out_features}] = {{{_row(layer.bias)}}};")
    return "\n".join(lines) + "\n"


def forward(network: PlanNetwork) -> list[str]:
    """Statements that take `seen` (double) to `raw` (float), through the buffers `h0`, `h1`."""
    layers = list(_layers(network))
    lines = [
        f"for (int i = 0; i < {layers[0].in_features}; ++i) h0[i] = ((float)seen[i] - centre[i]) / spread[i];"
    ]
    for number, layer in enumerate(layers):
        last = number == len(layers) - 1
        source, target = f"h{number % 2}", "raw" if last else f"h{(number + 1) % 2}"
        sizes = f"{layer.in_features}, {layer.out_features}"
        lines.append(
            f"layer({source}, {target}, &weight_{number}[0][0], bias_{number}, {sizes}, {int(not last)});"
        )
    return lines


def widest(network: PlanNetwork) -> int:
    """Numbers that a layer takes at most."""
    return max(layer.in_features for layer in _layers(network))


def _layers(network: PlanNetwork) -> Iterator[nn.Linear]:
    return (layer for layer in network.body if isinstance(layer, nn.Linear))


def _row(values: Tensor) -> str:
    return ", ".join(_float(value) for value in values.detach().to(torch.float32).tolist())


def _float(value: float) -> str:
    """A float32 that C reads back bit for bit."""
    text = f"{value:.9g}"
    return f"{text}f" if any(mark in text for mark in ".en") else f"{text}.0f"
