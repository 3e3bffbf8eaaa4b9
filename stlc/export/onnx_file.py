"""A sheet as a file of ONNX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from stlc.compile.backends.onnx.sheet import BATCH, Body, Value
from stlc.diagnostics import Diagnostic, MissingError
from stlc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray
    from onnx import GraphProto, NodeProto, TensorProto, ValueInfoProto

    from stlc.compile.backends.onnx.sheet import Node, Sheet

OPSET = 18
"""The functions of ONNX 1.13 (2022), which every runtime since knows."""
FORMAT = 8
"""The file format of that time."""


def require_onnx() -> None:
    """Raise MissingError (R301) unless `onnx` is installed."""
    try:
        import onnx  # noqa: F401
    except ImportError:
        message = "`--to onnx` needs the packages `onnx` and `onnxruntime`"
        raise MissingError(Diagnostic("R301", message, help=("pip install 'stlc[onnx]'",))) from None


def model_of(name: str, outputs: Mapping[str, Value], facts: Mapping[str, str]) -> bytes:
    """The file of a graph; its inputs are those of the sheet.

    Args:
        name: of the graph.
        outputs: name -> value, in order.
        facts: key -> text, the metadata of the file.
    """
    from onnx import checker, helper

    sheet = next(iter(outputs.values())).sheet
    model = helper.make_model(
        _graph(sheet, name, list(outputs.items())),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=FORMAT,
        producer_name="stlc",
        producer_version=__version__,
    )
    helper.set_model_props(model, dict(facts))
    checker.check_model(model)
    data: bytes = model.SerializeToString()
    return data


def _graph(sheet: Sheet, name: str, outputs: Iterable[tuple[str, Value]]) -> GraphProto:
    """The part of a sheet that outputs depend on, under the names that they are shown by."""
    from onnx import helper

    shown = list(outputs)
    nodes = sheet.needed([value for _, value in shown])
    read = {each for node in nodes for each in node.reads} | {value.name for _, value in shown}
    renamed = [helper.make_node("Identity", [value.name], [outside]) for outside, value in shown]
    return helper.make_graph(
        [*map(_node, nodes), *renamed],
        name,
        [_declared(each, each.name) for each in sheet.inputs],
        [_declared(value, outside) for outside, value in shown],
        [_constant(key, sheet.constants[key]) for key in sheet.constants if key in read],
    )


def _node(node: Node) -> NodeProto:
    from onnx import helper

    made = helper.make_node(node.op, list(node.inputs), list(node.outputs))
    for key, value in node.attributes:
        if isinstance(value, Body):
            prefix = value.sheet.prefix
            graph = _graph(value.sheet, key, [(f"{prefix}o{i}", out) for i, out in enumerate(value.outputs)])
            made.attribute.append(helper.make_attribute(key, graph))
        else:
            made.attribute.append(helper.make_attribute(key, value))
    return made


def _constant(name: str, array: NDArray[Any]) -> TensorProto:
    from onnx import numpy_helper

    return numpy_helper.from_array(array, name)


def _declared(value: Value, name: str) -> ValueInfoProto:
    from onnx import TensorProto, helper

    codes = {
        "float64": TensorProto.DOUBLE,
        "float32": TensorProto.FLOAT,
        "int64": TensorProto.INT64,
        "bool": TensorProto.BOOL,
    }
    shape = ["batch" if length == BATCH else length for length in value.shape]
    return helper.make_tensor_value_info(name, codes[value.kind], shape)
