"""Processes of plants, seen from stlc: start, requests with a time limit, end."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, MissingError, SystemFileError
from stlc.plants.declaration import OutputDecl, PlantDecl, PlantInput, VariableDecl
from stlc.plants.kinds import Reason
from stlc.plants.messages import Message, MessageError, encoded, received
from stlc.plants.watchdog import Watchdog
from stlc.units import parse_unit, same_dims

Floats: TypeAlias = NDArray[np.float64]
TAIL = 4000
"""Kept bytes of the standard error of a plant, the last ones."""
OPENING = 180.0
"""Seconds that a plant has to open, if a simulation may not take longer: imports on a busy machine."""
_LAST_WORDS = 1.0
"""Seconds to wait for the standard error of a process that has ended; a child may hold it open."""
_LONGEST = 1e6
"""Seconds of one wait at most: `poll` takes milliseconds of 31 bits."""
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
            self._watchdog.watch(self._process.pid)
        except BaseException:
            self._watchdog.end()
            raise
        self._tail, self._reading = bytearray(), threading.Lock()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._in, self._out = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._in, False)
        os.set_blocking(self._process.stderr.fileno(), False)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        try:
            self._open()
        except BaseException:
            self.end()
            raise

    def _open(self) -> None:
        """Open the plant. Raises the errors of the class."""
        decl = self._decl
        limit = max(float(decl.limits.time), OPENING)
        try:
            layout = {"layout": decl.layout(self._watchdog.folder).as_json()}
            header = self._answer(layout, None, time.monotonic() + limit, limit).header
        except FaultyError as error:
            raise _refused(
                decl, f"the plant cannot be opened: {error.fault.message}", "", error.fault.stderr
            ) from None
        if "absent" in header:
            package, extra = str(header["absent"]), str(header.get("extra"))
            advice = f"pip install 'stlc[{extra}]'" if extra else f"pip install {package}"
            message = f"this needs the package `{package}`, which is not installed"
            raise MissingError(Diagnostic("R301", message, help=(advice,)))
        if "unfit" in header:
            raise _refused(decl, str(header["unfit"]), str(header.get("place", "")), self._said())
        if isinstance(units := header.get("units"), Mapping):
            _require_units(decl, units)

    # ------------------------------------------------------------------------------ requests

    def request(self, header: Mapping[str, Any], array: Floats, deadline: float) -> Message:
        """Send a request and return the reply.

        Args:
            header: the request.
            array: its numbers, (rows, columns).
            deadline: latest time of the reply, by `time.monotonic`.

        Raises:
            FaultyError: the simulation failed. The process may have been ended; see `alive`.
        """
        return self._answer(header, array, deadline, float(self._decl.limits.time))

    def _answer(
        self, header: Mapping[str, Any], array: Floats | None, deadline: float, limit: float
    ) -> Message:
        """Send a request and return the reply; `limit` is the time that it had. Raises FaultyError."""
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
        try:
            self._send(encoded(header, array), deadline)
            return received(lambda count: self._received(count, deadline))
        except TimeoutError:
            message = f"not finished within {limit:g} s of the clock"
            raise self._faulty("time limit", message) from None
        except (EOFError, BrokenPipeError):
            raise self._faulty("crash", self._end_in_words()) from None
        except MessageError as error:
            raise self._faulty("bad message", f"the process of the plant sent {error}") from None

    def _faulty(self, reason: Reason, message: str) -> FaultyError:
        """End the process, and return the error."""
        self.end()
        return FaultyError(Fault(reason, message, None, self._said()))

    def _send(self, data: bytes, deadline: float) -> None:
        view = memoryview(data)
        while view:
            _await(self._in, select.POLLOUT, deadline)
            with suppress(BlockingIOError):
                view = view[os.write(self._in, view) :]

    def _received(self, count: int, deadline: float) -> bytes:
        parts: list[bytes] = []
        while count:
            _await(self._out, select.POLLIN, deadline)
            part = os.read(self._out, min(count, 1 << 20))
            if not part:
                raise EOFError
            parts.append(part)
            count -= len(part)
        return b"".join(parts)

    # ----------------------------------------------------------------------------------- end

    @property
    def alive(self) -> bool:
        """True if the process can take further requests."""
        return self._process.poll() is None and not self._process.stdin.closed  # type: ignore[union-attr]

    def end(self) -> None:
        """Kill the process and its children, and remove its temporary files; any thread may call it."""
        self._watchdog.end()  # before the process is waited for: then its number may be another's
        self._process.kill()
        self._process.wait()
        self._listener.join(_LAST_WORDS)
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                if stream is not None:
                    stream.close()

    def _listen(self) -> None:
        """Keep the last bytes of the standard error, until it ends."""
        assert self._process.stderr is not None
        poll = select.poll()
        poll.register(self._process.stderr.fileno(), select.POLLIN)
        while poll.poll():
            if not self._drain():
                return

    def _drain(self) -> bool:
        """Read the pending bytes of the standard error; return whether more may come."""
        stream = self._process.stderr
        assert stream is not None
        with self._reading:
            while not stream.closed:
                try:
                    part = os.read(stream.fileno(), 1 << 16)
                except BlockingIOError:
                    return True
                if not part:
                    stream.close()
                self._tail += part
                del self._tail[:-TAIL]
        return False

    def _said(self) -> str:
        """Return the end of the standard error, with all that was printed before the last reply."""
        self._drain()
        with self._reading:
            return self._tail.decode(errors="replace").strip()

    def _end_in_words(self) -> str:
        """Describe in one line how the process ended."""
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
        bufsize=0,
        start_new_session=True,
        env=environment,
        cwd=decl.path.parent.resolve(),
    )


def _await(number: int, event: int, deadline: float) -> None:
    """Wait until a file descriptor is ready. Raises TimeoutError at the deadline."""
    poll = select.poll()
    poll.register(number, event)
    while (rest := deadline - time.monotonic()) > 0:
        if poll.poll(1000 * min(rest, _LONGEST)):
            return
    raise TimeoutError


def _refused(decl: PlantDecl, message: str, place: str, said: str) -> SystemFileError:
    """Return the error S401, located at the key `place` of the plant file, or else at the plant itself."""
    span = decl.places.get(place) or decl.places.get(place.partition(".")[0]) or decl.places.get(decl.kind)
    note = tuple(f"it printed: {line}" for line in said.splitlines()[-3:])
    return SystemFileError(Diagnostic("S401", message, span, label="named here", note=note))


def _require_units(decl: PlantDecl, units: Mapping[str, Any]) -> None:
    """Raise S401 if a plant gives other units than its file declares; names that are no units are skipped."""
    sections: dict[str, tuple[VariableDecl | PlantInput | OutputDecl, ...]]
    sections = {"initial": decl.initial, "param": decl.param, "input": decl.inputs, "output": decl.outputs}
    for section, variables in sections.items():
        for each in variables:
            text = units.get(each.source)
            try:
                known = parse_unit(text) if isinstance(text, str) else None
            except ValueError:
                continue
            if known is None or not known.text or not each.unit.text:
                continue
            if not same_dims(known, each.unit) or known.scale != each.unit.scale:
                place = f"{section}.{each.name}"
                span = decl.places.get(f"{place}.unit") or decl.places.get(place)
                message = f"`{each.name}` is in [{known}] in the plant, and the file declares [{each.unit}]"
                advice = (f"{each.name}: {{unit: {text}}}",)
                raise SystemFileError(Diagnostic("S401", message, span, label="declared here", help=advice))
