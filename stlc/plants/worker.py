"""The process of a plant: `python -m stlc.plants.worker`.

It opens a plant, and simulates it on request. Requests and replies are messages (`stlc.plants.messages`) over
the standard input and output that the process was started with. The plant itself reads from nowhere and
prints to the standard error.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Any, BinaryIO

import numpy as np

from stlc.extras import NotInstalledError
from stlc.plants.controller import NetworkController
from stlc.plants.kind import (
    KINDS,
    BlackBox,
    FaultError,
    Floats,
    Layout,
    UnfitError,
    layout_of,
    vector,
)
from stlc.plants.messages import SAID, Message, encoded, received


class ControlledPlant:
    """A plant with its controller: simulations in parts."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._box: BlackBox = KINDS.get(layout.kind).open(layout)
        self.units = dict(self._box.units)
        self._controller = None if layout.controller is None else NetworkController(layout)
        self._y: Floats = np.zeros(0)
        self._param: Floats = np.zeros(0)
        self.step = 0

    def start(self, header: Any, array: Floats) -> Message:
        """Begin a simulation; return the outputs at time 0, (1, outputs).

        The array has one row: start values, parameters, and the free inputs at time 0.
        """
        initial, param, inputs = np.split(
            array[0], np.cumsum((len(self._layout.initial), len(self._layout.param)))
        )
        self.step, self._param = 0, param
        written = np.zeros(len(self._layout.inputs) - self._layout.free)
        seed = int(header["seed"])
        self._y = self._checked(self._box.start(initial, param, np.concatenate((inputs, written)), seed))
        return Message({"ended": False}, self._y[None])

    def advance(self, _header: Any, array: Floats) -> Message:
        """Advance by one step for each row of the free inputs, (steps, free inputs).

        The reply has a row for each step that was made: the outputs after it, then the inputs that the
        controller wrote before it.
        """
        free, outputs = self._layout.free, len(self._layout.outputs)
        rows = np.empty((len(array), outputs + len(self._layout.inputs) - free))
        for index, inputs in enumerate(array):
            if self._controller is not None:
                commands = self._controller.commands(self.step, self._y, inputs, self._param)
                rows[index, outputs:] = commands
                inputs = np.concatenate((inputs, commands))
            self._y = self._checked(self._box.step(inputs))
            rows[index, :outputs] = self._y
            self.step += 1
            if self._box.ended:
                return Message({"ended": True}, rows[: index + 1])
        return Message({"ended": False}, rows)

    def _checked(self, given: Any) -> Floats:
        found = vector(given, self._layout.outputs, "the outputs")
        if not np.isfinite(found).all():
            port = self._layout.outputs[int(np.argmin(np.isfinite(found)))]
            value = found[self._layout.outputs.index(port)]
            raise FaultError("not finite", f"the output `{port.name}` is {value}")
        return found


def serve(inbox: BinaryIO, outbox: BinaryIO) -> None:
    """Answer requests until the stream ends."""

    def read(count: int) -> bytes:
        found = inbox.read(count)
        if len(found) < count:
            raise EOFError
        return found

    simulator: ControlledPlant | None = None
    while True:
        try:
            request = received(read)
        except EOFError:
            return
        try:
            if simulator is None:
                layout = layout_of(request.header["layout"])
                with suppress(ImportError, OSError, ValueError):  # where the system has no limit
                    import resource

                    resource.setrlimit(resource.RLIMIT_AS, (layout.memory, layout.memory))
                simulator = ControlledPlant(layout)
                reply = Message({"units": simulator.units}, np.zeros((0, 0)))
            else:
                does: dict[str, Callable[[Any, Floats], Message]] = {
                    "start": simulator.start,
                    "advance": simulator.advance,
                }
                reply = does[request.header["do"]](request.header, request.array)
        except BaseException as error:  # what the code of a user raises
            reply = Message(_failure(error, 0 if simulator is None else simulator.step), np.zeros((0, 0)))
            with suppress(OSError):
                os.write(2, SAID)
        outbox.write(encoded(reply.header, reply.array))
        outbox.flush()


def _failure(error: BaseException, step: int) -> dict[str, Any]:
    """Header of the reply to a request that failed; unexpected errors, as of the plant, are also printed."""
    match error:
        case UnfitError():
            return {"unfit": str(error), "place": error.place}
        case NotInstalledError():
            return {"absent": error.name}
        case FaultError():
            return {"fault": error.reason, "message": str(error), "step": step}
        case MemoryError():
            return {"fault": "memory", "message": "out of memory", "step": step}
    with suppress(Exception):
        traceback.print_exception(error)
        sys.stderr.flush()
    message = f"{type(error).__name__}: {error}".strip(": ")[:500]
    return {"fault": "error", "message": message, "step": step}


def _disconnect(*numbers: int) -> None:
    """Replace file descriptors by an empty file, in a process that the plant has forked.

    It must neither answer requests, nor hold the streams open when the process of the plant has ended.
    """
    empty = os.open(os.devnull, os.O_RDWR)
    for number in numbers:
        os.dup2(empty, number, inheritable=False)
    os.close(empty)


def main() -> None:
    """Take the standard input and output for messages, and give the plant others."""
    inbox, outbox = os.dup(0), os.dup(1)
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, 0)
    os.close(nowhere)
    os.dup2(2, 1)
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: _disconnect(inbox, outbox))
    with open(inbox, "rb") as requests, open(outbox, "wb") as replies:  # noqa: PTH123
        serve(requests, replies)


if __name__ == "__main__":
    main()
