"""Processes of plants, seen from stlc: start, requests with a time limit, end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import TIMEOUT_MAX, Event, Thread
from typing import Any, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import SystemFileError
from stlc.extras import not_installed
from stlc.plants.declaration import OutputDecl, PlantDecl, PlantInput, VariableDecl
from stlc.plants.kind import Reason
from stlc.plants.messages import SAID, Message, MessageError, encoded, received
from stlc.plants.watchdog import Watchdog
from stlc.units import Unit

Floats: TypeAlias = NDArray[np.float64]
TAIL = 4000
"""Kept bytes of the standard error of a plant, the last ones."""
OPENING = 180.0
"""Seconds that a plant has to open, if a simulation may not take longer: imports on a busy machine."""
_LAST_WORDS = 1.0
"""Seconds to wait for the standard error of a process that has ended; a child may hold it open."""
_LEAVING = 10.0
"""Seconds that a process which has closed its output has to end by itself, on a busy machine."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Fault:
    """Reason why a request has no answer.

    Attributes:
        reason: kind of failure.
        message: the failure in one line.
        step: last step that the plant completed; None if it is unknown.
        stderr: end of what the plant printed.
    """

    reason: Reason
    message: str
    step: int | None
    stderr: str


class FaultyError(Exception):
    """Error: a request to a plant failed."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault.message)
        self.fault = fault


class PlantProcess:
    """A process in which one plant is open.

    Args:
        decl: the plant.

    Raises:
        SystemFileError: S401, the plant cannot be opened, or lacks what its file names.
        MissingError: R301, a package is not installed.
    """

    def __init__(self, decl: PlantDecl) -> None:
        self._decl = decl
        self._watchdog = Watchdog()
        try:
            self._process = _started(decl, self._watchdog.folder)
            self._watchdog.watch(self._process)
        except BaseException:
            self._watchdog.end()
            raise
        self._requests: SimpleQueue[bytes] = SimpleQueue()
        self._replies: SimpleQueue[Message | Exception] = SimpleQueue()
        self._tail, self._heard = b"", Event()
        self._listener = Thread(target=self._listen, daemon=True)
        for thread in (self._listener, Thread(target=self._exchange, daemon=True)):
            thread.start()
        try:
            self._open()
        except BaseException:
            self.end()
            raise

    def _open(self) -> None:
        decl = self._decl
        limit = max(float(decl.limits.time), OPENING)
        try:
            layout = {"layout": decl.layout(self._watchdog.folder).as_json()}
            header = self.request(layout, None, time.monotonic() + limit, limit).header
        except FaultyError as error:
            raise _refused(
                decl, f"the plant cannot be opened: {error.fault.message}", "", error.fault.stderr
            ) from None
        if "absent" in header:
            raise not_installed(str(header["absent"]))
        if "unfit" in header:
            raise _refused(decl, str(header["unfit"]), str(header.get("place", "")), self._said())
        if isinstance(units := header.get("units"), Mapping):
            _require_units(decl, units)

    # ------------------------------------------------------------------------------ requests

    def request(
        self, header: Mapping[str, Any], array: Floats | None, deadline: float, limit: float | None = None
    ) -> Message:
        """Send a request and return the reply.

        Args:
            header: the request.
            array: its numbers, (rows, columns); None for none.
            deadline: latest time of the reply, by `time.monotonic`.
            limit: seconds that the request has, for messages; by default those of a simulation.

        Raises:
            FaultyError: the simulation failed. The process may have been ended; see `alive`.
        """
        limit = float(self._decl.limits.time) if limit is None else limit
        reply = self._exchanged(header, array, deadline, limit)
        reason = reply.header.get("fault")
        if reason is None:
            return reply
        step = reply.header.get("step")
        raise FaultyError(
            Fault(
                reason if reason in get_args(Reason) else "bad message",
                str(reply.header.get("message", ""))[:500],
                step if isinstance(step, int) else None,
                self._said(),
            )
        )

    def _exchanged(
        self, header: Mapping[str, Any], array: Floats | None, deadline: float, limit: float
    ) -> Message:
        self._heard.clear()
        self._requests.put(encoded(header, array))
        try:
            reply = self._replies.get(timeout=min(max(deadline - time.monotonic(), 0.0), TIMEOUT_MAX))
        except Empty:
            raise self._faulty("time limit", f"not finished within {limit:g} s of the clock") from None
        match reply:
            case Message():
                return reply
            case MessageError():
                raise self._faulty("bad message", f"the process of the plant sent {reply}")
        raise self._faulty("crash", self._end_in_words())

    def _faulty(self, reason: Reason, message: str) -> FaultyError:
        self.end()
        return FaultyError(Fault(reason, message, None, self._said()))

    def _exchange(self) -> None:
        """Send requests and receive replies, in a thread that a plant may block, until an empty request."""
        with self._process.stdout as replies, self._process.stdin as requests:  # type: ignore[union-attr]

            def read(count: int) -> bytes:
                if len(part := replies.read(count)) < count:
                    raise EOFError
                return part

            with suppress(OSError):  # where the pipe is closed with a request in it
                for request in iter(self._requests.get, b""):
                    try:
                        requests.write(request)
                        requests.flush()
                        self._replies.put(received(read))
                    except (OSError, EOFError, MessageError) as error:
                        self._replies.put(error)

    # ----------------------------------------------------------------------------------- end

    @property
    def alive(self) -> bool:
        """True if the process can take further requests."""
        return self._process.poll() is None

    def end(self) -> None:
        """Kill the process and its children, and remove its temporary files; any thread may call it."""
        self._watchdog.end()
        self._requests.put(b"")
        self._listener.join(_LAST_WORDS)

    def _listen(self) -> None:
        """Keep the last bytes of the standard error, until it ends."""
        with self._process.stderr as stream:  # type: ignore[union-attr]
            while part := os.read(stream.fileno(), 1 << 16):
                self._tail = (self._tail + part)[-TAIL:]
                if SAID in self._tail:
                    self._tail = self._tail.replace(SAID, b"")
                    self._heard.set()
        self._heard.set()

    def _said(self) -> str:
        """Return the end of the standard error, with all that was printed before the last fault."""
        self._heard.wait(_LAST_WORDS)
        return self._tail.decode(errors="replace").strip()

    def _end_in_words(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_LEAVING)
        code = self._process.returncode
        if code is None:
            return "the process of the plant closed its output"
        if code < 0:
            with suppress(ValueError):
                return f"the process of the plant was ended by {signal.Signals(-code).name}"
        return f"the process of the plant ended with exit code {code}"


def _started(decl: PlantDecl, scratch: str) -> subprocess.Popen[bytes]:
    """Start the process of a plant, in the folder of the plant file and in a session of its own."""
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {
        **os.environ,
        **dict.fromkeys(_THREADS, "1"),
        "PYTHONPATH": os.pathsep.join(paths),
        "TMPDIR": scratch,
    }
    return subprocess.Popen(
        [sys.executable, "-B", "-P", "-m", "stlc.plants.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env=environment,
        cwd=decl.path.parent.resolve(),
    )


def _refused(decl: PlantDecl, message: str, place: str, said: str) -> SystemFileError:
    """Return the error S401, located at the key `place` of the plant file, or else at the plant itself."""
    span = decl.places.get(place) or decl.places.get(place.partition(".")[0]) or decl.places.get(decl.kind)
    note = tuple(f"it printed: {line}" for line in said.splitlines()[-3:])
    return SystemFileError.of("S401", message, span, label="named here", note=note)


def _require_units(decl: PlantDecl, units: Mapping[str, Any]) -> None:
    """Raise S401 if a plant gives other units than its file declares; names that are no units are skipped."""
    sections: dict[str, tuple[VariableDecl | PlantInput | OutputDecl, ...]]
    sections = {"initial": decl.initial, "param": decl.param, "input": decl.inputs, "output": decl.outputs}
    for section, variables in sections.items():
        for each in variables:
            text = units.get(each.source)
            try:
                known = Unit.parse(text) if isinstance(text, str) else None
            except ValueError:
                continue
            if known is None or not known.text or not each.unit.text:
                continue
            if not known.same_dims(each.unit) or known.scale != each.unit.scale:
                place = f"{section}.{each.name}"
                span = decl.places.get(f"{place}.unit") or decl.places.get(place)
                message = f"`{each.name}` is in [{known}] in the plant, and the file declares [{each.unit}]"
                advice = (f"{each.name}: {{unit: {text}}}",)
                raise SystemFileError.of("S401", message, span, label="declared here", help=advice)
