"""Interface of the kinds of plants: a black box that is opened, started and stepped; its ports and faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stlc.registry import PackageRegistry

Floats: TypeAlias = NDArray[np.float64]
Reason: TypeAlias = Literal[
    "crash", "time limit", "memory", "error", "not finite", "wrong shape", "bad message"
]
"""Reason for which a simulation gave no trace."""
SCRATCH = "stlc-plant-"
"""Prefix of the names of folders for temporary files, one for each process of a plant."""
KINDS: PackageRegistry[Any] = PackageRegistry(
    "kind of plant",
    "stlc.plants.kinds",
    "KIND",
    default="python",
    group="stlc.plants",
    accepts="stlc.plants.kind:PlantKind",
)
"""Kinds of plants (`PlantKind`) by the key of plant files that names a plant of this kind."""


@dataclass(frozen=True, slots=True)
class Port:
    """A number that goes into a plant or comes out of it.

    Attributes:
        name: name in specifications.
        source: name in the plant.
        low: lower end of its range; None if it has none.
        high: upper end of its range.
    """

    name: str
    source: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True)
class ControllerLayout:
    """A controller in the loop with a plant.

    Attributes:
        path: file of the ONNX network.
        reads: names of outputs, inputs and parameters that the network reads, in order.
        writes: names of the inputs that it writes, in order.
        period: steps of the plant between two evaluations.
        scale: factor of the numbers that the network gives.
        offset: number that is added afterwards.
    """

    path: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    period: int
    scale: float
    offset: float


@dataclass(frozen=True, slots=True)
class Layout:
    """Data with which the process of a plant starts.

    Attributes:
        kind: name of the kind of plant.
        options: the value of the key of that name in the plant file.
        folder: folder of the plant file.
        scratch: folder for temporary files.
        dt: time step in seconds.
        duration: length of a simulation in seconds.
        memory: most bytes of address space.
        halves: whether the plant must accept another time step than that of its file.
        initial: start values.
        param: parameters.
        inputs: input signals; those that the controller writes come last.
        outputs: output signals.
        controller: controller in the loop, or None.
    """

    kind: str
    options: Mapping[str, Any]
    folder: str
    scratch: str
    dt: float
    duration: float
    memory: int
    halves: bool
    initial: tuple[Port, ...]
    param: tuple[Port, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    controller: ControllerLayout | None = None

    @property
    def free(self) -> int:
        """Number of inputs that no controller writes."""
        return len(self.inputs) - (0 if self.controller is None else len(self.controller.writes))

    def path(self, name: str) -> Path:
        """Path of the file `name`, which the plant file names."""
        return Path(self.folder, name)

    def as_json(self) -> dict[str, Any]:
        """JSON data from which `layout_of` makes an equal object."""
        return asdict(self)


def layout_of(data: Mapping[str, Any]) -> Layout:
    """Return the layout that `Layout.as_json` has written."""
    ports = {
        key: tuple(Port(**each) for each in data[key]) for key in ("initial", "param", "inputs", "outputs")
    }
    controller = data["controller"]
    if controller is not None:
        names = {key: tuple(controller[key]) for key in ("reads", "writes")}
        controller = ControllerLayout(**{**controller, **names})
    return Layout(**{**data, **ports, "controller": controller})


class BlackBox(Protocol):
    """Interface of an opened plant, in its process."""

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of a port by its name in the plant, where the plant knows it."""

    @property
    def ended(self) -> bool:
        """True if the plant has ended the simulation by itself."""

    def start(self, initial: Floats, param: Floats, inputs: Floats, seed: int) -> ArrayLike:
        """Begin a new simulation at time 0, and return the outputs.

        Args:
            initial: start values, in the order of the plant file.
            param: parameters.
            inputs: input signals at time 0.
            seed: seed for plants that draw random numbers.
        """

    def step(self, inputs: Floats) -> ArrayLike:
        """Advance by one time step with constant inputs, and return the outputs at its end."""


@dataclass(frozen=True, slots=True)
class PlantKind:
    """A kind of plant.

    Attributes:
        record: dataclass of the keys of its mapping in a plant file.
        main: key that is meant if the plant file has a text in place of the mapping.
        open: function that opens a plant in its process. It raises `UnfitError` if the plant lacks what the
            layout names.
        sources: function that returns the name in the plant of the i-th port of a section, if the plant file
            does not give it. By default, it is the name of the port.
        files: function of the options and the folder of the plant file that returns the files of which the
            plant consists, by name. It runs nothing.
        packages: packages that simulate plants of this kind.
        own_step: whether the plant itself fixes the time step.
    """

    record: type
    main: str
    open: Callable[[Layout], BlackBox]
    sources: Callable[[str, int, str], str] = field(default=lambda _section, _index, name: name)
    files: Callable[[Mapping[str, Any], Path], Mapping[str, Path]] = field(
        default=lambda _options, _folder: {}
    )
    packages: tuple[str, ...] = ()
    own_step: bool = False


class UnfitError(Exception):
    """Error: a plant cannot be opened, or lacks what its file names.

    `place` is the key of the plant file that is wrong, such as `output.h`; "" stands for the plant itself.
    """

    def __init__(self, message: str, place: str = "") -> None:
        super().__init__(message)
        self.place = place


class FaultError(Exception):
    """Error: a simulation has failed for a reason that the worker has recognised."""

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason: Reason = reason


def vector(numbers: Any, ports: tuple[Port, ...], what: str) -> Floats:
    """Return the numbers that a plant gave for `ports`: from a mapping by source, or a sequence in order.

    `what` names them in messages. Raises FaultError if there are more, fewer or other ones.
    """
    if isinstance(numbers, Mapping):
        missing = [port.source for port in ports if port.source not in numbers]
        if missing:
            raise FaultError("wrong shape", f"{what} lack `{missing[0]}`")
        numbers = [numbers[port.source] for port in ports]
    try:
        found = np.asarray(numbers, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FaultError("wrong shape", f"{what} are not numbers: {str(error)[:200]}") from error
    if found.size != len(ports):
        raise FaultError(
            "wrong shape", f"{what} are {found.size:,} numbers of shape {found.shape}, not {len(ports)}"
        )
    return found.reshape(-1)
