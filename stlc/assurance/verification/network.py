"""Bounds on the outputs of a feed-forward network over boxes of inputs, and on the plans of a policy.

All neurons of a layer are affine forms in the same symbols. A neuron has a symbol of its own for what a line
cannot follow of its activation (Singh et al. 2018). Symbols belong to one box, and are numbered without gaps
in each: their number is that of the unstable neurons of a box, not of the batch. Where a network computes in
float32, a sum of n products, in any order, is within n 2^-24 / (1 - n 2^-24) of the sum of the magnitudes
(Higham 2002, section 3.1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from stlc.assurance.verification.forms import FORMS, SLACK, Floats, Forms
from stlc.controller.policies.policy import PlanNetwork
from stlc.controller.problem.task import Task
from stlc.diagnostics import usage
from stlc.dynamics.model.controls import raw_width, shares

UNIT = 2.0**-24
"""Relative rounding error of one operation in float32."""

_LARGE = 1e-4
"""Remainder from which a neuron gets a symbol; smaller ones, of rounding errors, are added up."""

_KEPT = 12
"""Symbols of neurons that the outputs of a policy keep; the others become one symbol for each output."""


@dataclass(frozen=True, slots=True, eq=False)
class NetworkLayer:
    """Layer of a network: `activation(weight x + bias)`.

    Attributes:
        weight: (outputs, inputs).
        bias: (outputs,).
        activation: a name in `ACTIVATIONS`.
    """

    weight: Floats
    bias: Floats
    activation: str = "linear"


ACTIVATIONS: Mapping[str, Callable[[Forms], Forms]] = {
    "linear": lambda x: x,
    "relu": lambda x: FORMS.maximum(x, 0.0),
    "tanh": lambda x: FORMS.tanh(x),
    "sigmoid": lambda x: FORMS.sigmoid(x),
}
"""Activation -> its bounds."""


class NetworkBounds:
    """Bounds on the outputs of a feed-forward network.

    Args:
        layers: the layers, in order.
        unit: relative rounding error of one operation of the network that is described: `UNIT` for float32.
    """

    def __init__(self, layers: Sequence[NetworkLayer], unit: float = UNIT) -> None:
        self._layers, self._unit = tuple(layers), unit

    def outputs(self, inputs: Forms, rows: slice = slice(None)) -> Forms:
        """Forms (batch, outputs) for forms (batch, inputs); `rows` selects outputs of the last layer."""
        neurons = inputs
        for layer in self._layers[:-1]:
            neurons = self._layer(neurons, layer)
        last = self._layers[-1]
        return self._layer(neurons, NetworkLayer(last.weight[rows], last.bias[rows], last.activation))

    def _layer(self, x: Forms, layer: NetworkLayer) -> Forms:
        """Outputs of a layer; each large remainder of an input becomes a symbol."""
        weight, size = layer.weight.T, np.abs(layer.weight.T)
        symbols, batch, width = x.generators.shape
        chosen, own, rest = _large(x.rest, _LARGE)
        generators = np.empty((symbols + len(chosen), batch, weight.shape[1]))
        np.matmul(
            x.generators.reshape(-1, width), weight, out=generators[:symbols].reshape(-1, weight.shape[1])
        )
        np.multiply(own[:, :, None], weight[chosen], out=generators[symbols:])
        terms = width + 2.0
        most = (np.abs(x.centre) + x.radius) @ size + np.abs(layer.bias)
        error = rest @ size + most * (terms * self._unit / (1.0 - terms * self._unit)) + SLACK
        found = Forms(x.centre @ weight + layer.bias, generators, error)
        if layer.activation == "linear":
            return found
        active = ACTIVATIONS[layer.activation](found)
        if layer.activation == "relu":  # exact
            return active
        return active.widened(0.0, 8.0 * self._unit)


def joined(forms: Sequence[Forms], symbols: int) -> Forms:
    """Forms (batch,) of several quantities as one array of forms, (batch, quantities).

    The array has generators for all `symbols` that are in use, also by forms that are not among these, so
    that symbols that are appended to it are new.
    """
    generators = np.zeros((symbols, len(forms[0].centre), len(forms)))
    for i, each in enumerate(forms):
        generators[: len(each.generators), :, i] = each.generators
    return Forms(
        np.stack([each.centre for each in forms], 1), generators, np.stack([each.rest for each in forms], 1)
    )


def columns(x: Forms) -> list[Forms]:
    """Forms (batch, quantities) as a list of forms (batch,)."""
    return [
        Forms(x.centre[:, i], np.ascontiguousarray(x.generators[:, :, i]), x.rest[:, i])
        for i in range(x.centre.shape[1])
    ]


def own_symbols(x: Forms, large: float = _LARGE) -> Forms:
    """The same forms (batch, width), in which each large remainder has become an appended symbol."""
    chosen, size, rest = _large(x.rest, large)
    own = np.zeros((len(chosen), *x.rest.shape))
    np.put_along_axis(own, chosen[:, :, None], size[:, :, None], axis=2)
    return Forms(x.centre, np.concatenate((x.generators, own)), rest)


def _large(rest: Floats, large: float) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Large remainders among those of quantities, (batch, width), and the remainders without them.

    Returns:
        Numbers of the quantities with the large remainders of each box, and these, (most of a box, batch)
        both; a box with fewer has other quantities with a 0.
    """
    big = rest > large
    most = int(big.sum(1).max(initial=0))
    chosen = np.argsort(~big, axis=1, kind="stable")[:, :most]
    own = np.take_along_axis(np.where(big, rest, 0.0), chosen, 1)
    return np.ascontiguousarray(chosen.T), np.ascontiguousarray(own.T), np.where(big, 0.0, rest)


def reduced(x: Forms, first: int, most: int) -> Forms:
    """Forms (batch, width) with the first symbols, and the `most` largest ones of the others at most.

    What is left out is added to the remainders.
    """
    if len(x.generators) <= first + most:
        return x
    others = x.generators[first:]
    size = np.abs(others)
    order = np.argsort(-size.sum(2), axis=0)[:most, :, None]
    kept, known = np.take_along_axis(others, order, 0), np.take_along_axis(size, order, 0)
    rest = x.rest + np.maximum(size.sum(0) - known.sum(0), 0.0) + SLACK
    return Forms(x.centre, np.concatenate((x.generators[:first], kept)), rest)


class PlanBounds:
    """Bounds on single plans of a policy's network, with weights in float64.

    Raises:
        ValueError: an angle among the controls, with a range other than one turn around 0.
    """

    def __init__(self, network: PlanNetwork, task: Task) -> None:
        self._controls = task.system.decl.controls
        for control in self._controls:
            if control.squash == "angle" and abs(control.low + control.high) > 1e-9:
                raise ValueError(f"the angle `{control.name}` has a range that is not around 0")
        modules = [module for module in network.body if isinstance(module, nn.Linear)]
        kinds = ["relu"] * (len(modules) - 1) + ["linear"]
        self._network = NetworkBounds(
            [
                NetworkLayer(_array(each.weight), _array(each.bias), kind)
                for each, kind in zip(modules, kinds, strict=True)
            ]
        )
        self._centre, self._spread = _array(network.centre), _array(network.spread)
        self._low, self._high = _array(task.system.control_low), _array(task.system.control_high)
        self._steps, self._width, self._clock = task.horizon, raw_width(self._controls), network.clock

    def plan(self, observed: Sequence[Forms], index: int, symbols: int) -> list[list[Forms]]:
        """Forms of proposal number `index`: one list per step with one form (batch,) per control.

        `symbols` is the number of symbols in use by all states, observed or not; those of the plan are new.

        Raises:
            UsageError: U101, plans reach to the end of a mission, and the boxes hold several times of it.
        """
        begun = 0
        if self._clock is not None:
            now = observed[self._clock].range
            begun = round(float(now.low.min()))
            if now.low.min() < begun - 0.5 or now.high.max() > begun + 0.5:
                raise usage("boxes of states at several times of a mission cannot be verified together")
        width = self._steps * self._width
        rows = slice(index * width, (index + 1) * width)
        raw = reduced(self._network.outputs(self._inputs(observed, symbols), rows), symbols, _KEPT)
        first = len(raw.generators)
        outputs = [each.with_symbol(first + i) for i, each in enumerate(columns(raw))]
        half, middle = 0.5 * (self._high - self._low), 0.5 * (self._high + self._low)
        # The functions are exact within 4 units of the last place; the rest is for the map.
        error = 16.0 * UNIT * (np.abs(middle) + half)
        plan = []
        for step in range(self._steps):
            at = self._width * min(begun + step, self._steps - 1)
            found = shares(outputs[at : at + self._width], self._controls, FORMS)
            plan.append([each.times(half[i]).widened(middle[i], error[i]) for i, each in enumerate(found)])
        return plan

    def _inputs(self, observed: Sequence[Forms], symbols: int) -> Forms:
        x = joined(observed, symbols)
        error = 4.0 * UNIT * (np.abs(x.centre) + x.radius + np.abs(self._centre)) + SLACK
        found = Forms(
            (x.centre - self._centre) / self._spread,
            x.generators / self._spread,
            (x.rest + error) / self._spread,
        )
        return own_symbols(found)


def _array(tensor: torch.Tensor) -> Floats:
    return tensor.detach().cpu().to(torch.float64).numpy()
