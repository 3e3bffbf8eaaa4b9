"""ONNX files of a controller, and `controller.json`, which describes it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias, get_args

import numpy as np
import torch

from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.backends.onnx.graph import BATCH, KINDS, GraphBody, GraphNode, OnnxGraph, Value
from stlc.controller.guard.candidates import grid_of
from stlc.controller.run.run import Run
from stlc.diagnostics import usage
from stlc.export.onnx_graphs import deciding, falling, following, judging
from stlc.extras import needed
from stlc.jsontext import dumps
from stlc.provenance import sha256
from stlc.runtime import Controller
from stlc.runtime.facts import FACTS, FORMAT, ControllerQuantity, GraphFile
from stlc.version import __version__

if TYPE_CHECKING:
    from onnx import GraphProto, NodeProto, ValueInfoProto

    from stlc.controller.problem.task import Task


# ----------------------------------------------------------------------------------------------- files


Precision: TypeAlias = Literal["float64", "float32"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
OPSET = 18
"""The operator set of ONNX 1.13 (2022), which all later runtimes support."""
IR_VERSION = 8
"""The file format version of that release."""


def require_onnx() -> None:
    """Raise MissingError (R301) if the package `onnx` is not installed."""
    needed("onnx", "`--to onnx` needs")


def model_of(
    name: str, outputs: Mapping[str, Value], facts: Mapping[str, str], real: Precision = "float64"
) -> bytes:
    """Return the content of an ONNX file with the graph that computes `outputs`.

    Args:
        name: name of the graph.
        outputs: name -> value, in order.
        facts: metadata of the file, key -> text.
        real: element type that takes the place of float64, in all values and constants.
    """
    from onnx import checker, helper

    graph = next(iter(outputs.values())).graph
    model = helper.make_model(
        _graph(graph, name, list(outputs.items()), real),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="stlc",
        producer_version=__version__,
    )
    helper.set_model_props(model, dict(facts))
    checker.check_model(model)
    data: bytes = model.SerializeToString()
    return data


def _graph(graph: OnnxGraph, name: str, outputs: Iterable[tuple[str, Value]], real: Precision) -> GraphProto:
    """ONNX graph called `name`, with those nodes of `graph` on which `outputs` depend.

    `outputs`: public name -> value, as pairs. `real` takes the place of float64.
    """
    from onnx import helper, numpy_helper

    shown = list(outputs)
    nodes = graph.needed([value for _, value in shown])
    read = {each for node in nodes for each in node.reads} | {value.name for _, value in shown}
    renamed = [helper.make_node("Identity", [value.name], [outside]) for outside, value in shown]
    return helper.make_graph(
        [*(_node(node, real) for node in nodes), *renamed],
        name,
        [_declared(each, each.name, real) for each in graph.inputs],
        [_declared(value, outside, real) for outside, value in shown],
        [
            numpy_helper.from_array(array.astype(real) if array.dtype == np.float64 else array, key)
            for key, array in graph.constants.items()
            if key in read
        ],
    )


def _node(node: GraphNode, real: Precision) -> NodeProto:
    from onnx import helper

    made = helper.make_node(node.op, list(node.inputs), list(node.outputs))
    for key, value in node.attributes:
        if isinstance(value, GraphBody):
            prefix = value.graph.prefix
            outputs = [(f"{prefix}o{i}", out) for i, out in enumerate(value.outputs)]
            graph = _graph(value.graph, key, outputs, real)
            made.attribute.append(helper.make_attribute(key, graph))
        else:
            double = node.op == "Cast" and value == KINDS["float64"]
            made.attribute.append(helper.make_attribute(key, KINDS[real] if double else value))
    return made


def _declared(value: Value, name: str, real: Precision) -> ValueInfoProto:
    from onnx import helper

    shape = ["batch" if length == BATCH else length for length in value.shape]
    return helper.make_tensor_value_info(name, KINDS[real if value.kind == "float64" else value.kind], shape)


# ---------------------------------------------------------------------------------------- a controller


TIMED = 200
"""Number of decisions that are timed."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Decision time of one agent on one thread in milliseconds: median and 99th percentile."""

    JSON: ClassVar = "median_ms=median p99_ms=p99"

    median: float
    p99: float


def write_onnx(run: Run, folder: Path, real: Precision = "float64") -> None:
    """Write `decide.onnx`, `follow.onnx`, `judge.onnx` and `controller.json`, and up to two more files.

    `fall.onnx` is written if the specification has safety requirements. `continue.onnx` is written if the
    policy tries changed copies of a plan that violates the specification. Numbers are of the type `real`.

    Raises:
        UsageError: U101, a part of the task has no ONNX form.
        MissingError: R301, `onnx` or `onnxruntime` is not installed.
    """
    require_onnx()
    task, facts = run.task, {**_facts(run), "precision": real}
    graphs: dict[str, Callable[[], dict[str, Value]]] = {
        GraphFile.DECIDE: lambda: deciding(task, run.network),
        GraphFile.FOLLOW: lambda: following(task, run.network),
        GraphFile.JUDGE: lambda: judging(task),
    }
    if len(run.network.changes):
        graphs[GraphFile.CONTINUE] = lambda: deciding(task, run.network, varied=False)
    if task.compiled.safety:
        graphs[GraphFile.FALL] = lambda: falling(task)
    digests = {}
    for name, make in graphs.items():
        try:
            outputs = make()
        except Untranslatable as error:
            message = f"this task has no form as an ONNX graph: {error}"
            raise usage(message, "take --to torch instead") from error
        data = model_of(Path(name).stem, outputs, {"stlc": dumps(facts)}, real)
        (folder / name).write_bytes(data)
        digests[name] = sha256(data)
    (folder / FACTS).write_text(
        dumps({**facts, "files": digests}, indent=1) + "\n", encoding="utf-8", newline="\n"
    )


def _facts(run: Run) -> dict[str, object]:
    """Content of `controller.json`: names, units, ranges, hashes, and the prefixes of the backup policy.

    The prefixes are the sequences of actions that the backup policy tries as the first part of a plan. They
    are given by the values of each control, and by their lengths.
    """
    task, grid = run.task, grid_of(run.task)
    feedback = task.system.decl.feedback
    return {
        "format": FORMAT,
        "stlc": __version__,
        "run": run.dir.name,
        "spec": {"name": task.compiled.name, "sha256": run.dir.hashes["spec_hash"]},
        "system": {"name": task.system.decl.name, "sha256": run.dir.hashes["system_hash"]},
        "states": [asdict(each) for each in _states(task)],
        "controls": [
            asdict(ControllerQuantity(each.name, str(each.unit), each.low, each.high))
            for each in task.system.decl.controls
        ],
        "feedback": None if feedback is None else asdict(feedback),
        "requirements": [rule.name for rule in task.rules],
        "dt": task.system.dt,
        "horizon": task.horizon,
        "backup": asdict(grid),
    }


def _states(task: Task) -> list[ControllerQuantity]:
    timers = {timer.name: timer.initial for timer in task.system.timers}
    parameters = {each.column.name for each in task.system.parameters}
    return [
        ControllerQuantity(
            each.name,
            str(each.unit),
            each.low,
            each.high,
            "timer" if each.name in timers else "parameter" if each.name in parameters else "",
            timers.get(each.name),
        )
        for each in task.system.signature.columns
    ]


def timed(task: Task, folder: Path) -> Latency:
    """Measure decision times of the Python runtime with the files in `folder`, in random states."""
    controller = Controller.load(folder)
    times = []
    for state in task.sample(TIMED, seed=8, dtype=torch.float64).numpy():
        started = time.perf_counter()
        controller.decide(state)
        times.append(1e3 * (time.perf_counter() - started))
    median, p99 = np.percentile(times[10:], (50, 99))
    return Latency(float(median), float(p99))
