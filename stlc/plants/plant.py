"""Plants from elsewhere as simulators: points of their declared ranges in, traces or findings out."""

from __future__ import annotations

import time
import weakref
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import usage
from stlc.plants.declaration import PlantDecl, load_plant_decl
from stlc.plants.kind import Reason
from stlc.plants.messages import Message
from stlc.plants.process import Fault, FaultyError, PlantProcess
from stlc.signature import Column, Signature
from stlc.stopping import leaving
from stlc.trace import Trace, TraceMeta
from stlc.units import Unit

if TYPE_CHECKING:
    from stlc.monitor.online.online import Online

Floats: TypeAlias = NDArray[np.float64]
CHUNK = 4096
"""Time steps that a plant makes between two messages."""


@dataclass(frozen=True, slots=True)
class PlantVariable:
    """One component of a point: a start value, a parameter, or a number that determines an input signal.

    Attributes:
        name: name, such as `h`, or `force_values[0]` for the first value of the input signal `force`.
        low: lower end of its range.
        high: upper end of its range.
        unit: unit of the range and of the values.
    """

    name: str
    low: float
    high: float
    unit: Unit


@dataclass(frozen=True, slots=True)
class PlantFinding:
    """A simulation that gave no trace: the plant crashed, hung, or returned invalid outputs.

    Attributes:
        reason: kind of failure.
        message: the failure in one line.
        point: name of each variable -> its value at this point.
        seed: seed of the simulation.
        time: time of the simulation that the plant had reached, in seconds; None if unknown.
        stderr: end of what the process printed to its standard error (and standard output).
    """

    JSON: ClassVar = "reason message time stderr"

    reason: Reason
    message: str
    point: Mapping[str, float]
    seed: int
    time: float | None
    stderr: str


@dataclass(frozen=True, slots=True)
class PlantRun:
    """One simulation of a plant.

    Attributes:
        point: values of the variables, (dim,).
        seed: seed for plants that draw random numbers.
        outcome: the trace, or the finding if there is none.
    """

    point: Floats
    seed: int
    outcome: Trace | PlantFinding


class FindingError(Exception):
    """Error: a simulation in parts has failed; `finding` says why."""

    def __init__(self, finding: PlantFinding) -> None:
        super().__init__(f"{finding.reason}: {finding.message}")
        self.finding = finding


def load_plant(path: Path | str) -> Plant:
    """Read a plant file; nothing that it names is run before the first simulation.

    Raises:
        UsageError: U102, the file does not exist.
        SpecError: the file is not text.
        SystemFileError: the file is invalid; carries all findings.
    """
    return Plant(load_plant_decl(path))


class Plant:
    """A black box with declared ranges, which is simulated in processes of its own.

    The processes start with the first simulation and are used again. `close`, or the end of a `with` block,
    ends them.

    Args:
        decl: the plant.
    """

    def __init__(self, decl: PlantDecl) -> None:
        self.decl = decl
        self.variables = tuple(_variables(decl))
        self._processes: list[PlantProcess] = []
        self._idle: list[PlantProcess] = []
        self._stopped = False
        self._close = weakref.finalize(self, _end, self._processes)

    def __enter__(self) -> Plant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all processes. Later simulations start new ones."""
        self._idle.clear()
        _end(self._processes)

    # ---------------------------------------------------------------------------- points

    @property
    def low(self) -> Floats:
        """Lower ends of the ranges of the variables, (dim,)."""
        return np.array([each.low for each in self.variables], dtype=np.float64)

    @property
    def high(self) -> Floats:
        """Upper ends of the ranges of the variables, (dim,)."""
        return np.array([each.high for each in self.variables], dtype=np.float64)

    def points_of(self, uniforms: Floats) -> Floats:
        """Return the points that uniform random numbers give: (batch, dim) between 0 and 1 -> (batch, dim).

        Values are uniformly distributed over their ranges, which they never leave. Free times of input
        signals are sorted.
        """
        low, high = self.low, self.high
        found = np.minimum(low + (high - low) * np.asarray(uniforms, dtype=np.float64), high)
        for signal, columns in self._free():
            if columns:
                found[:, columns] = signal.drawn(np.asarray(uniforms, dtype=np.float64)[:, columns])
        return found

    def random_point(self, seed: int) -> Floats:
        """Return the random point of a seed, (dim,)."""
        uniforms: Floats = np.random.default_rng(seed).random((1, len(self.variables)))
        (found,) = self.points_of(uniforms)
        return np.asarray(found)

    def _free(self) -> Iterator[tuple[Any, list[int]]]:
        """Yield the free input signals with the positions of their variables; none if the value is fixed."""
        names = {each.name: index for index, each in enumerate(self.variables)}
        for signal in self.decl.free:
            fixed = signal.low == signal.high
            yield signal, [] if fixed else [names[column] for column in signal.columns]

    def _inputs(self, point: Floats, times: Floats) -> Floats:
        """Return the free input signals at given times: (steps,) -> (steps, free inputs)."""
        found = np.empty((len(times), len(self.decl.free)))
        for index, (signal, columns) in enumerate(self._free()):
            if not columns:
                found[:, index] = signal.low
                continue
            numbers = point[columns].copy()
            numbers[signal.points :] = np.sort(numbers[signal.points :])
            values = signal.at(numbers[None], times)[0]
            found[:, index] = np.clip(values, signal.low, signal.high)  # but for rounding they are inside
        return found

    # ------------------------------------------------------------------------ simulation

    def simulate(
        self, points: Floats, *, seeds: Sequence[int] | None = None, jobs: int = 1
    ) -> list[PlantRun]:
        """Simulate the plant at each point.

        Args:
            points: values of the variables, (batch, dim), each in the unit of its variable.
            seeds: seed of each simulation, for plants that draw random numbers; by default 0.
            jobs: number of processes that simulate at the same time.

        Returns:
            One run per point, in order. A simulation that fails is a finding, not an error.

        Raises:
            SystemFileError: S401, the plant cannot be opened, or lacks what its file names.
            MissingError: R301, a package is not installed.
            UsageError: U101, the points do not have one number per variable.
        """
        points = self._checked(points)
        chosen = [0] * len(points) if seeds is None else [int(seed) for seed in seeds]
        if len(chosen) != len(points):
            raise usage(f"{len(chosen)} seeds are given for {len(points)} points")
        if min(jobs, len(points)) <= 1:
            return [self._run(point, seed) for point, seed in zip(points, chosen, strict=True)]
        executor = ThreadPoolExecutor(min(jobs, len(points)))
        try:
            return list(executor.map(self._run, points, chosen))
        except BaseException:  # such as Ctrl-C: simulations in progress end now
            self._stopped = True
            executor.shutdown(wait=False, cancel_futures=True)
            self.close()
            raise
        finally:
            executor.shutdown(wait=True)
            self._stopped = False

    def _checked(self, points: Floats) -> Floats:
        found = np.asarray(points, dtype=np.float64)
        if found.ndim != 2 or found.shape[1] != len(self.variables):
            raise usage(
                f"points of `{self.decl.name}` have {len(self.variables)} numbers, these are {found.shape}"
            )
        return found

    def _run(self, point: Floats, seed: int) -> PlantRun:
        try:
            parts = list(self.parts(point, seed=seed))
        except FindingError as error:
            return PlantRun(point, seed, error.finding)
        first = parts[0]
        names = first.signature.names
        data = {name: np.concatenate([part.data[name] for part in parts], axis=1) for name in names}
        return PlantRun(point, seed, replace(first, data=data))

    def parts(self, point: Floats, *, seed: int = 0, samples: int = CHUNK) -> Iterator[Trace]:
        """Simulate the plant at one point, and yield its trace in parts of at most `samples` samples.

        Memory does not depend on the length of the simulation. The times of the parts follow each other
        without overlap. A plant that ends the simulation by itself gives a shorter trace.

        Raises:
            FindingError: the simulation failed.
            SystemFileError: S401, the plant cannot be opened, or lacks what its file names.
            MissingError: R301, a package is not installed.
        """
        (point,) = self._checked(np.asarray(point)[None])
        process = self._taken()
        deadline = time.monotonic() + float(self.decl.limits.time)
        try:
            with leaving(lambda _code: process.end()):
                yield from _Simulation(self, process, point, seed, deadline).parts(samples)
        except FaultyError as error:
            process.end()  # a plant that has failed may fail again without cause
            fault, names = error.fault, [each.name for each in self.variables]
            values = dict(zip(names, point.tolist(), strict=True))
            reached = None if fault.step is None else fault.step * float(self.decl.dt)
            finding = PlantFinding(fault.reason, fault.message, values, seed, reached, fault.stderr)
            raise FindingError(finding) from None
        except BaseException:
            process.end()
            raise
        finally:
            if process.alive and not self.decl.limits.fresh:
                self._idle.append(process)
            else:
                self._discard(process)

    def watch(self, point: Floats, monitor: Online, *, seed: int = 0) -> PlantFinding | None:
        """Simulate the plant at one point, and feed its samples into an online monitor.

        Memory is bounded by the windows of the requirements, not by the length of the simulation. Returns the
        finding if the simulation fails; the monitor has then received the samples before the last message of
        the plant.

        Raises:
            SystemFileError, MissingError: as `parts`.
            TraceError: the errors of `Online.feed`.
        """
        try:
            for part in self.parts(point, seed=seed):
                monitor.feed(part)
        except FindingError as error:
            return error.finding
        return None

    def _taken(self) -> PlantProcess:
        """Return a process that waits for requests; start one if there is none."""
        while self._idle:
            process = self._idle.pop()
            if process.alive:
                return process
            self._discard(process)
        process = PlantProcess(self.decl)
        self._processes.append(process)
        if self._stopped:
            self._discard(process)
            raise KeyboardInterrupt
        return process

    def _discard(self, process: PlantProcess) -> None:
        process.end()
        if process in self._processes:
            self._processes.remove(process)

    @property
    def signature(self) -> Signature:
        """Columns of the traces: outputs, inputs, and the parameters as constants."""
        decl = self.decl
        outputs = (Column(each.name, each.unit, role="output") for each in decl.outputs)
        inputs = (
            Column(each.name, each.unit, role="input", low=each.low, high=each.high) for each in decl.inputs
        )
        param = (
            Column(each.name, each.unit, role="env", low=each.low, high=each.high) for each in decl.param
        )
        return Signature((*outputs, *inputs, *param))


class _Simulation:
    def __init__(
        self, plant: Plant, process: PlantProcess, point: Floats, seed: int, deadline: float
    ) -> None:
        self.plant, self.process, self.deadline, self.seed = plant, process, deadline, seed
        self.decl, self.point = plant.decl, point
        names = {each.name: value for each, value in zip(plant.variables, point, strict=True)}
        self.initial = [names.get(each.name, each.low) for each in self.decl.initial]
        self.param = np.array([names.get(each.name, each.low) for each in self.decl.param])
        self.meta = TraceMeta(
            system_name=self.decl.name,
            system_path=str(self.decl.path),
            system_text=self.decl.source.text,
            seed=seed,
            dt=float(self.decl.dt),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )

    def parts(self, samples: int) -> Iterator[Trace]:
        """Yield the trace in parts of at most `samples` samples, but at least two."""
        decl, size = self.decl, max(samples, 2)
        written = len(decl.inputs) - len(decl.free)
        first = np.concatenate((self.initial, self.param, self._inputs(0, 1)[0]))
        y = self._request({"do": "start", "seed": self.seed}, first[None], len(decl.outputs)).array
        step = 0
        while True:
            count = min(size - 1 if step == 0 else size, decl.steps - step)
            u = self._inputs(step, count + 1)
            reply = self._request({"do": "advance", "at": step}, u[:-1], len(decl.outputs) + written, count)
            made = len(reply.array)
            after, w = np.split(reply.array, [len(decl.outputs)], axis=1)
            ended = bool(reply.header.get("ended")) or step + made == decl.steps
            # the sample at the end of these steps belongs to the next part, which knows its commands
            y = np.concatenate((y, after))
            rows = made + 1 if ended else made
            commands = np.concatenate((w, w[-1:]))[:rows]
            yield self._trace(step, np.concatenate((y[:rows], u[:rows], commands), axis=1))
            if ended:
                return
            step, y = step + made, y[made:]

    def _inputs(self, step: int, count: int) -> Floats:
        times = float(self.decl.dt) * np.arange(step, step + count, dtype=np.float64)
        return self.plant._inputs(self.point, times)

    def _request(self, header: Mapping[str, Any], array: Floats, columns: int, most: int = 1) -> Message:
        """Send a request, and check the numbers of the reply."""
        reply = self.process.request(header, array, self.deadline)
        rows, found = reply.array.shape
        full = rows == most or (1 <= rows < most and reply.header.get("ended") is True)
        at = header.get("at")
        if not full or found != columns:
            message = f"the process of the plant sent {rows} x {found} numbers, not {most} x {columns}"
            raise FaultyError(Fault("bad message", message, at, ""))
        if not np.isfinite(reply.array).all():
            raise FaultyError(Fault("not finite", "an output is not finite", at, ""))
        return reply

    def _trace(self, step: int, values: Floats) -> Trace:
        signature = self.plant.signature
        columns = np.concatenate(
            (values, np.broadcast_to(self.param, (len(values), len(self.param)))), axis=1
        )
        data = {
            name: np.ascontiguousarray(columns[:, index])[None] for index, name in enumerate(signature.names)
        }
        dt = float(self.decl.dt)
        return Trace(signature, dt, data, step * dt, meta=self.meta, name=self.decl.name)


def _variables(decl: PlantDecl) -> Iterator[PlantVariable]:
    for each in (*decl.initial, *decl.param):
        if each.low < each.high:
            yield PlantVariable(each.name, each.low, each.high, each.unit)
    for signal in decl.free:
        if signal.low < signal.high:
            for name in signal.values:
                yield PlantVariable(name, signal.low, signal.high, signal.unit)
            for name in signal.times:
                yield PlantVariable(name, 0.0, float(signal.duration), Unit.parse("s"))


def _end(processes: list[PlantProcess]) -> None:
    while processes:
        processes.pop().end()
