"""Shared parts of the tests of graphs: a graph is run by onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnxruntime

from stlc.compile.backends.onnx.graph import BATCH, OnnxGraph, Value
from stlc.export.onnx_write import model_of


def columns_on(graph: OnnxGraph, names: tuple[str, ...], rows: int) -> dict[str, Value]:
    """Columns (rows, batch) that are given."""
    return {name: graph.input(name, (rows, BATCH)) for name in names}


def computed(outputs: Mapping[str, Value], given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The values of outputs where inputs are given."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    model = model_of("test", outputs, {})
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    wanted = [each.name for each in session.get_inputs()]
    return dict(zip(outputs, session.run(list(outputs), {name: given[name] for name in wanted}), strict=True))
