"""Recorder of ONNX graphs: symbolic arrays and the operations between them.

To the evaluators a `Value` looks like an array: it has a shape, slices along time, and arithmetic. Each
operation becomes a node of the graph that the value belongs to; equal nodes are shared.
`stlc.export.onnx_write` writes graphs to files; this module does not import ONNX.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Kind: TypeAlias = Literal["float64", "float32", "int64", "bool"]
KINDS: Mapping[Kind, int] = {"float32": 1, "int64": 7, "bool": 9, "float64": 11}
"""Element type -> its number in `onnx.TensorProto.DataType`."""
Attribute: TypeAlias = "int | tuple[int, ...] | GraphBody"

BATCH = 1 << 40
"""Axis length known only at run time; all such axes in one operation have the same length."""


@dataclass(frozen=True, slots=True)
class GraphNode:
    """ONNX operation, with the names of its inputs and outputs."""

    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: tuple[tuple[str, Attribute], ...]

    @property
    def reads(self) -> frozenset[str]:
        """Names of the values that the node reads.

        For a loop or a condition, these include values of the enclosing graph that the bodies read.
        """
        bodies = (value for _, value in self.attributes if isinstance(value, GraphBody))
        return frozenset(self.inputs).union(*(body.around for body in bodies))


@dataclass(frozen=True, slots=True, eq=False)
class GraphBody:
    """Body of a loop, or branch of a condition: a graph inside a node.

    Attributes:
        graph: graph of one iteration or of the branch; `graph.inputs` are its inputs.
        outputs: values that each iteration, or the branch, returns.
    """

    graph: OnnxGraph
    outputs: tuple[Value, ...]

    @property
    def nodes(self) -> list[GraphNode]:
        """Nodes that an iteration or the branch needs, in order."""
        return self.graph.needed(self.outputs)

    @property
    def around(self) -> frozenset[str]:
        """Names of values of the enclosing graph that the body reads."""
        nodes = self.nodes
        read = {name for node in nodes for name in node.reads} | {value.name for value in self.outputs}
        made = {name for node in nodes for name in node.outputs}
        return frozenset(
            read - made - self.graph.constants.keys() - {value.name for value in self.graph.inputs}
        )


@dataclass(slots=True)
class OnnxGraph:
    """ONNX graph under construction.

    Attributes:
        nodes: operations in order.
        constants: name -> array.
        inputs: input values of the graph.
        prefix: start of the names that the graph creates. It differs between a loop body and the enclosing
            graph, so that their names differ too.
    """

    nodes: list[GraphNode] = field(default_factory=list)
    constants: dict[str, NDArray[Any]] = field(default_factory=dict)
    inputs: list[Value] = field(default_factory=list)
    prefix: str = ""
    _known: dict[tuple[object, ...], tuple[Value, ...]] = field(default_factory=dict)

    def input(self, name: str, shape: tuple[int, ...], kind: Kind = "float64") -> Value:
        """Add an input of the graph; return it as a symbolic array."""
        self.inputs.append(Value(self, name, shape, kind))
        return self.inputs[-1]

    def constant(self, value: object, kind: Kind = "float64") -> Value:
        """Return a constant of any shape; equal constants are shared."""
        array = np.asarray(value, dtype=kind)
        key = ("constant", kind, array.shape, array.tobytes())
        if key not in self._known:
            name = f"{self.prefix}c{len(self.constants)}"
            self.constants[name] = array
            self._known[key] = (Value(self, name, array.shape, kind),)
        return self._known[key][0]

    def emit(
        self,
        op: str,
        inputs: Sequence[Value],
        shapes: Sequence[tuple[int, ...]],
        kind: Kind,
        attributes: Mapping[str, Attribute] | None = None,
    ) -> tuple[Value, ...]:
        """Add a node, or reuse an equal one; return the outputs of the node.

        Args:
            op: ONNX operation.
            inputs: operands.
            shapes: shape of each output.
            kind: element type of the outputs.
            attributes: name of an ONNX attribute -> its value.
        """
        facts = tuple(sorted((attributes or {}).items()))
        names = tuple(value.name for value in inputs)
        key = (op, names, facts, len(shapes))
        if key not in self._known:
            made = tuple(
                Value(self, f"{self.prefix}v{len(self.nodes)}.{place}", shape, kind)
                for place, shape in enumerate(shapes)
            )
            self.nodes.append(GraphNode(op, names, tuple(value.name for value in made), facts))
            self._known[key] = made
        return self._known[key]

    def branched(self, where: Value, yes: Branch, no: Branch) -> tuple[Value, ...]:
        """Write a condition as an `If` node: only the operations of one branch are executed.

        Args:
            where: the condition, a single bool of shape ().
            yes: branch that is executed if the condition holds, a function graph -> outputs. It adds
                operations to the graph that it gets. If it reads a value of the enclosing graph, it must
                convert the value by `Value.on`.
            no: branch that is executed otherwise, a function like `yes`. Its outputs have the same shapes as
                those of `yes`. All outputs of both branches have the same element type.

        Returns:
            Outputs of the branch that is executed.
        """
        bodies = []
        for mark, branch in (("y", yes), ("n", no)):
            inner = OnnxGraph(prefix=f"{self.prefix}{mark}{len(self.nodes)}.")
            bodies.append(GraphBody(inner, tuple(branch(inner))))
        outputs = bodies[0].outputs
        facts: dict[str, Attribute] = dict(zip(("then_branch", "else_branch"), bodies, strict=True))
        return self.emit("If", (where,), [each.shape for each in outputs], outputs[0].kind, facts)

    def needed(self, outputs: Sequence[Value]) -> list[GraphNode]:
        """Return the nodes that `outputs` depend on, in order."""
        wanted, kept = {value.name for value in outputs}, []
        for node in reversed(self.nodes):
            if wanted & set(node.outputs):
                wanted |= node.reads
                kept.append(node)
        return kept[::-1]


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """Symbolic array.

    Attributes:
        graph: graph that the value belongs to.
        name: name of the value in the graph.
        shape: lengths of the axes; `BATCH` for an unknown length.
        kind: element type.
    """

    graph: OnnxGraph
    name: str
    shape: tuple[int, ...]
    kind: Kind

    def on(self, graph: OnnxGraph) -> Value:
        """Return this value for use in a loop body or a branch.

        The value belongs to the enclosing graph; `graph` is the graph of the loop body or branch.
        """
        return Value(graph, self.name, self.shape, self.kind)

    # ----------------------------------------------------------------- arithmetic

    def __add__(self, other: Value | float) -> Value:
        return self.apply("Add", other)

    def __radd__(self, other: float) -> Value:
        return self.beside(other).apply("Add", self)

    def __sub__(self, other: Value | float) -> Value:
        return self.apply("Sub", other)

    def __rsub__(self, other: float) -> Value:
        return self.beside(other).apply("Sub", self)

    def __mul__(self, other: Value | float) -> Value:
        return self.apply("Mul", other)

    def __rmul__(self, other: float) -> Value:
        return self.beside(other).apply("Mul", self)

    def __truediv__(self, other: Value | float) -> Value:
        return self.apply("Div", other)

    def __rtruediv__(self, other: float) -> Value:
        return self.beside(other).apply("Div", self)

    def __ge__(self, other: Value | float) -> Value:
        return self.apply("GreaterOrEqual", other, kind="bool")

    def __lt__(self, other: Value | float) -> Value:
        return self.apply("Less", other, kind="bool")

    def __neg__(self) -> Value:
        return self.apply("Neg")

    def beside(self, other: Value | float) -> Value:
        """Return `other` as a symbolic array: a float becomes a constant of this array's element type.

        A symbolic array is returned unchanged.
        """
        return other if isinstance(other, Value) else self.graph.constant(other, self.kind)

    def apply(self, op: str, *others: Value | float, kind: Kind | None = None) -> Value:
        """Apply the elementwise ONNX operation `op` to this value and `others`; shapes broadcast.

        `kind` is the element type of the result; None means that of this value.
        """
        parts = [self.beside(other) for other in others]
        (out,) = self.graph.emit(op, (self, *parts), [self.broadcast(*parts)], kind or self.kind)
        return out

    def broadcast(self, *others: Value) -> tuple[int, ...]:
        """Shape to which this value and `others` broadcast."""
        return reduce(_broadcast, (other.shape for other in others), self.shape)

    def cast(self, kind: Kind) -> Value:
        """Convert to another element type."""
        if kind == self.kind:
            return self
        (out,) = self.graph.emit("Cast", (self,), [self.shape], kind, {"to": KINDS[kind]})
        return out

    # --------------------------------------------------------------------- shapes

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __getitem__(self, rows: slice | int) -> Value:
        """Slice along axis 0; a single index removes the axis."""
        if isinstance(rows, int):
            index = self.graph.constant(rows % self.shape[0], "int64")
            (out,) = self.graph.emit("Gather", (self, index), [self.shape[1:]], self.kind, {"axis": 0})
            return out
        first, stop, step = rows.indices(self.shape[0])
        count = len(range(first, stop, step))
        if count == self.shape[0] and step == 1:
            return self
        ends = stop if stop >= 0 else -self.shape[0] - 1
        numbers = [self.graph.constant([number], "int64") for number in (first, ends, 0, step)]
        (out,) = self.graph.emit("Slice", (self, *numbers), [(count, *self.shape[1:])], self.kind)
        return out

    def rows(self) -> tuple[Value, ...]:
        """Split into rows along axis 0, (1, …) each."""
        count = self.shape[0]
        if count == 1:
            return (self,)
        sizes = self.graph.constant([1] * count, "int64")
        shapes = [(1, *self.shape[1:])] * count
        return self.graph.emit("Split", (self, sizes), shapes, self.kind, {"axis": 0})

    def reshaped(self, *shape: int) -> Value:
        """Reshape; at most one length of the new shape may be `BATCH` (unknown)."""
        wanted = self.graph.constant([-1 if length == BATCH else length for length in shape], "int64")
        (out,) = self.graph.emit("Reshape", (self, wanted), [shape], self.kind)
        return out

    def transposed(self, *order: int) -> Value:
        """Permute the axes."""
        shape = tuple(self.shape[axis] for axis in order)
        (out,) = self.graph.emit("Transpose", (self,), [shape], self.kind, {"perm": order})
        return out

    @property
    def T(self) -> Value:  # noqa: N802 - as arrays call it
        """Transpose of an array with two axes."""
        return self.transposed(1, 0)

    def expand(self, *shape: int, like: Value | None = None) -> Value:
        """Expand axes of length 1, so that the result has the given shape.

        If a length in the shape is `BATCH` (unknown), that axis gets the length of the last axis of `like`.
        """
        if self.shape == shape:
            return self
        parts = [self.graph.constant([1 if length == BATCH else length], "int64") for length in shape]
        if like is not None and like.shape[-1] == BATCH and BATCH in shape:
            parts[shape.index(BATCH)] = like.count()
        wanted = joined(parts)
        (out,) = self.graph.emit("Expand", (self, wanted), [shape], self.kind)
        return out

    def count(self) -> Value:
        """Length of the last axis, as a symbolic array (1,) of the type int64."""
        (out,) = self.graph.emit("Shape", (self,), [(1,)], "int64", {"start": self.ndim - 1})
        return out


Branch: TypeAlias = Callable[[OnnxGraph], Sequence[Value]]


def joined(parts: Sequence[Value], axis: int = 0) -> Value:
    """Concatenate along an axis; the other axes must agree."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    shape = list(first.shape)
    shape[axis] = sum(part.shape[axis] for part in parts)
    (out,) = first.graph.emit("Concat", parts, [tuple(shape)], first.kind, {"axis": axis})
    return out


def _broadcast(a: tuple[int, ...], b: tuple[int, ...]) -> tuple[int, ...]:
    length = max(len(a), len(b))
    left, right = (1,) * (length - len(a)) + a, (1,) * (length - len(b)) + b
    for one, other in zip(left, right, strict=True):
        assert one == other or 1 in (one, other), f"{a} and {b}"
    return tuple(other if one == 1 else one for one, other in zip(left, right, strict=True))
