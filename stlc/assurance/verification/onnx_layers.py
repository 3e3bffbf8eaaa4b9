"""Feed-forward networks in ONNX, read as layers: a chain of linear maps and activations.

Linear maps that follow each other are multiplied into one. Nothing in a file is executed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stlc.assurance.verification.forms import Floats
from stlc.assurance.verification.network import NetworkLayer
from stlc.diagnostics import StlcError, usage
from stlc.extras import needed

WIDEST = 100_000
"""Largest number of inputs of a network."""
_REAL = (1, 11)
"""Types of ONNX to which a cast is no operation of the network: float32 and float64."""


def read_onnx(path: Path) -> list[NetworkLayer]:
    """Read a feed-forward network: one input, one output, and a chain of layers.

    Raises:
        UsageError: U101, the file cannot be read, or has an operation that is not supported.
        MissingError: R301, the package onnx is missing.
    """
    onnx = needed("onnx", "a network in ONNX needs")
    try:
        return _layers(onnx.load(str(path), load_external_data=False).graph, path)
    except StlcError:
        raise
    except Exception as error:  # damage of any kind: libraries raise whatever they meet
        raise usage(f"`{path}` is not a network in ONNX: {str(error)[:200]}") from None


def _layers(graph: Any, path: Path) -> list[NetworkLayer]:
    from onnx import helper, numpy_helper

    constants = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    chain = _Chain()
    inputs = [each for each in graph.input if each.name not in constants]
    if len(inputs) != 1 or len(graph.output) != 1:
        raise usage(f"`{path}` does not have one input and one output")
    here = inputs[0].name
    shape = [each.dim_value for each in inputs[0].type.tensor_type.shape.dim]
    chain.size = max([each for each in shape if each > 0], default=0)
    if chain.size > WIDEST:
        raise usage(f"`{path}` has an input of {chain.size:,} numbers; at most {WIDEST:,} can be verified")
    for node in graph.node:
        if node.op_type != "Constant" and here not in node.input:
            raise usage(f"`{path}` is not a chain of layers: `{node.op_type}` reads another value")
        try:
            options = {each.name: helper.get_attribute_value(each) for each in node.attribute}
            if node.op_type == "Constant":
                constants[node.output[0]] = numpy_helper.to_array(options["value"])
                continue
            values = [np.asarray(constants[name], dtype=np.float64) for name in node.input if name != here]
            if not all(np.isfinite(value).all() for value in values):
                raise ValueError("a weight is not finite")
            chain.add(node.op_type, values, options, first=node.input[0] == here)
        except (KeyError, ValueError, IndexError) as error:
            raise usage(
                f"`{path}` has an operation that is not supported: {node.op_type} ({error})"
            ) from None
        here = node.output[0]
    if here != graph.output[0].name:
        raise usage(f"`{path}` is not a chain of layers: its output is not that of the last one")
    return chain.finished()


class _Chain:
    """Layers that are read so far, and a linear map after them."""

    def __init__(self) -> None:
        self.size = 0
        self._layers: list[NetworkLayer] = []
        self._map: tuple[Floats, Floats] | None = None

    def add(self, kind: str, values: Sequence[Floats], options: Mapping[str, Any], *, first: bool) -> None:
        """Add an operation; `values` are its constant operands, `first` says that the chain comes first."""
        if kind == "Cast" and options.get("to") not in _REAL:
            raise ValueError("to a type other than float32 and float64")
        if kind in ("Identity", "Flatten", "Reshape", "Squeeze", "Unsqueeze", "Dropout", "Cast"):
            return
        if kind in ("Relu", "Tanh", "Sigmoid"):
            self._layers.append(NetworkLayer(*self._linear(self.size), kind.lower()))
            self._map = None
        elif kind == "Gemm" and first and not options.get("transA", 0):
            weight = values[0] if options.get("transB", 0) else values[0].T
            bias = values[1].reshape(-1) if len(values) > 1 else np.zeros(len(weight))
            self._compose(weight * options.get("alpha", 1.0), bias * options.get("beta", 1.0))
        elif kind == "MatMul":
            weight = values[0].T if first else values[0]
            self._compose(weight, np.zeros(len(weight)))
        elif kind in ("Add", "Sub", "Mul", "Div") and (first or kind in ("Add", "Mul")):
            value = values[0].reshape(-1)
            size = self._linear(max(self.size, value.size))[0].shape[0]
            value = np.broadcast_to(value, size)
            if kind in ("Add", "Sub"):
                self._compose(np.eye(size), value if kind == "Add" else -value)
            else:
                self._compose(np.diag(value if kind == "Mul" else 1.0 / value), np.zeros(size))
        else:
            raise ValueError("no layer of a feed-forward network")

    def _linear(self, size: int) -> tuple[Floats, Floats]:
        """The linear map after the layers; the identity if there is none."""
        if self._map is not None:
            return self._map
        size = self._layers[-1].weight.shape[0] if self._layers else size
        return np.eye(size), np.zeros(size)

    def _compose(self, weight: Floats, bias: Floats) -> None:
        before, shift = self._linear(weight.shape[1])
        self._map = weight @ before, weight @ shift + bias

    def finished(self) -> list[NetworkLayer]:
        """All layers, the last one linear."""
        return [*self._layers, NetworkLayer(*self._linear(self.size))]
