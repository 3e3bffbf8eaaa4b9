"""Bounds on the plans of a network over boxes of initial states.

All neurons of a layer are affine forms in the same symbols. Each neuron has a symbol of its own for the
deviation of its ReLU from a line (Singh et al. 2018). The network computes in float32: the error of a sum of
n products, in any order, is at most n 2^-24 / (1 - n 2^-24) times the sum of their magnitudes (Higham 2002,
section 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from stlc.controller.policies.policy import PlanNetwork
from stlc.controller.problem.task import Task
from stlc.controller.verification.forms import SLACK, Floats, Forms, tanh

_LARGE = 1e-4
"""Remainder from which a neuron gets a symbol; smaller ones, of rounding errors, are added up."""

_UNIT = 2.0**-24
"""Relative rounding error of one operation in float32."""


@dataclass(frozen=True, slots=True)
class _Layer:
    weight: Floats
    bias: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Neurons:
    """Affine forms of a layer: centre and remainder (batch, width), generators (symbols, batch, width)."""

    centre: Floats
    generators: Floats
    rest: Floats

    def radius(self) -> Floats:
        found: Floats = np.abs(self.generators).sum(0) + self.rest
        return found

    def with_own_symbols(self) -> _Neurons:
        """The same forms, in which each large remainder has become a symbol that later layers share."""
        large = np.flatnonzero(self.rest.max(0) > _LARGE)
        own = np.zeros((len(large), *self.rest.shape))
        own[np.arange(len(large)), :, large] = self.rest[:, large].T
        rest = self.rest.copy()
        rest[:, large] = 0.0
        return _Neurons(self.centre, np.concatenate((self.generators, own)), rest)


class PlanBounds:
    """Bounds on single plans of a network, with weights in float64.

    Raises:
        ValueError: the network uses a mirror symmetry, or squashes its outputs other than by tanh.
    """

    def __init__(self, network: PlanNetwork, task: Task) -> None:
        controls = task.system.decl.controls
        if network.mirror is not None or {control.squash for control in controls} != {"tanh"}:
            raise ValueError("only networks without mirror, with controls squashed by tanh")
        modules = [module for module in network.body if isinstance(module, nn.Linear)]
        self._layers = [_Layer(_array(each.weight), _array(each.bias)) for each in modules]
        self._centre, self._spread = _array(network.centre), _array(network.spread)
        self._low, self._high = _array(task.system.control_low), _array(task.system.control_high)
        self._steps = task.horizon

    def plan(self, observed: Sequence[Forms], index: int) -> list[list[Forms]]:
        """Forms of proposal number `index`: one list per step with one form (batch,) per control."""
        neurons = self._inputs(observed)
        for layer in self._layers[:-1]:
            neurons = _relu(_linear(neurons, layer)).with_own_symbols()
        last, width = self._layers[-1], self._steps * len(self._low)
        rows = slice(index * width, (index + 1) * width)
        raw = _linear(neurons, _Layer(last.weight[rows], last.bias[rows])).with_own_symbols()
        outputs = [
            tanh(Forms(raw.centre[:, i], raw.generators[:, :, i], raw.rest[:, i])) for i in range(width)
        ]
        half, middle = 0.5 * (self._high - self._low), 0.5 * (self._high + self._low)
        error = 16.0 * _UNIT * (np.abs(middle) + half)  # tanh within 4 units of the last place, and the map
        controls = len(half)
        return [
            [
                outputs[step * controls + i].times(half[i]).widened(middle[i], error[i])
                for i in range(controls)
            ]
            for step in range(self._steps)
        ]

    def _inputs(self, observed: Sequence[Forms]) -> _Neurons:
        batch, symbols = len(observed[0].centre), max(len(each.generators) for each in observed)
        generators = np.zeros((symbols, batch, len(observed)))
        for i, each in enumerate(observed):
            generators[: len(each.generators), :, i] = each.generators
        centre = np.stack([each.centre for each in observed], 1)
        rest = np.stack([each.rest for each in observed], 1)
        most = np.abs(centre) + np.abs(generators).sum(0) + rest
        error = 4.0 * _UNIT * (most + np.abs(self._centre)) + SLACK
        found = _Neurons(
            (centre - self._centre) / self._spread, generators / self._spread, (rest + error) / self._spread
        )
        return found.with_own_symbols()


def _array(tensor: torch.Tensor) -> Floats:
    return tensor.detach().cpu().to(torch.float64).numpy()


def _linear(x: _Neurons, layer: _Layer) -> _Neurons:
    """`W x + b`."""
    weight, size = layer.weight.T, np.abs(layer.weight.T)
    symbols, batch, width = x.generators.shape
    generators = (x.generators.reshape(-1, width) @ weight).reshape(symbols, batch, -1)
    terms = width + 2.0
    most = (np.abs(x.centre) + x.radius()) @ size + np.abs(layer.bias)
    error = x.rest @ size + most * (terms * _UNIT / (1.0 - terms * _UNIT)) + SLACK
    return _Neurons(x.centre @ weight + layer.bias, generators, error)


def _relu(x: _Neurons) -> _Neurons:
    radius = x.radius()
    low, high = np.minimum(x.centre - radius, 0.0), np.maximum(x.centre + radius, 0.0)
    slope = high / np.maximum(high - low, 1e-300)
    half = -0.5 * slope * low
    return _Neurons(x.centre * slope + half, x.generators * slope, x.rest * slope + half)
