"""Neural network controllers in ONNX, in the loop with a plant.

A network has one input and one output, each a vector, with or without a batch axis of length 1.
"""

from __future__ import annotations

from typing import Any, final

import numpy as np

from stlc.extras import needed
from stlc.plants.kind import FaultError, Floats, Layout, UnfitError

_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}


@final
class NetworkController:
    """A network that reads signals of a plant and writes inputs of it.

    Raises:
        NotInstalledError: onnxruntime is not installed.
        UnfitError: the file cannot be read, or the sizes of the network differ from the plant file.
    """

    def __init__(self, layout: Layout) -> None:
        onnxruntime = needed("onnxruntime")
        assert layout.controller is not None
        self._declared = declared = layout.controller
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        path = layout.path(declared.path)
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise UnfitError(f"`{path}` cannot be read: {str(error)[:500]}", "controller.onnx") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or inputs[0].type not in _TYPES:
            raise UnfitError(f"`{path.name}` does not have one input of real numbers", "controller.onnx")
        self._input, self._output = inputs[0].name, outputs[0].name
        self._type = _TYPES[inputs[0].type]
        self._shape = _shape(inputs[0].shape, len(declared.reads), path.name)
        written = layout.inputs[layout.free :]
        self._low = np.array([-np.inf if port.low is None else port.low for port in written])
        self._high = np.array([np.inf if port.high is None else port.high for port in written])
        names = [port.name for port in (*layout.outputs, *layout.inputs[: layout.free], *layout.param)]
        self._read = np.array([names.index(name) for name in declared.reads], dtype=np.intp)
        self._commands: Floats = np.zeros(len(declared.writes))

    def commands(self, step: int, outputs: Floats, inputs: Floats, param: Floats) -> Floats:
        """Return the inputs that the controller writes, for the sample `step`.

        They are computed every `period` steps, and held in between. Values beyond the range of an input are
        limited to it.
        """
        if step % self._declared.period == 0:
            signals = np.concatenate((outputs, inputs, param))[self._read]
            given = signals.astype(self._type).reshape(self._shape)
            try:
                found: Any = self._session.run([self._output], {self._input: given})[0]
            except Exception as error:  # its errors have no common class
                raise FaultError("crash", f"the controller fails: {str(error)[:500]}") from error
            numbers = np.asarray(found, dtype=np.float64).reshape(-1)
            if numbers.size != len(self._low):
                message = f"the controller gives {numbers.size} numbers, and `writes` names {len(self._low)}"
                raise FaultError("wrong shape", message)
            if not np.isfinite(numbers).all():
                raise FaultError("not finite", "the controller gives a number that is not finite")
            scaled = self._declared.scale * numbers + self._declared.offset
            self._commands = np.clip(scaled, self._low, self._high)
        return self._commands


def _shape(shape: list[Any], size: int, name: str) -> tuple[int, ...]:
    """Return the shape in which a network takes `size` numbers; free axes but the last have length 1."""
    fixed = [each if isinstance(each, int) and each > 0 else 0 for each in shape]
    if 0 not in fixed:
        found = tuple(fixed)
    else:  # a free axis is the vector if no other one can be
        last = len(fixed) - 1 - next((i for i, each in enumerate(reversed(fixed)) if each == 0), 0)
        vector = last if size not in fixed else fixed.index(size)
        found = tuple(size if i == vector else each or 1 for i, each in enumerate(fixed))
    if int(np.prod(found)) != size:
        wanted = " x ".join(str(each) for each in shape) or "one number"
        raise UnfitError(f"`{name}` takes {wanted}, and `reads` names {size}", "controller.reads")
    return found
