"""Description of an exported controller, as stored in `controller.json`."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, RunError, usage
from stlc.runtime.prefixes import SAMPLINGS, PrefixGrid

Numbers: TypeAlias = NDArray[np.float64]
FACTS = "controller.json"
FORMAT = "stlc-controller/1"
MAX_STEPS, MAX_PREFIXES = 100_000, 10_000_000
"""Largest number of steps of a plan, and of prefixes of one length, that a description may ask for."""
_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
)


class GraphFile(StrEnum):
    """Files of the graphs of an exported controller."""

    DECIDE = "decide.onnx"
    FOLLOW = "follow.onnx"
    JUDGE = "judge.onnx"
    FALL = "fall.onnx"
    CONTINUE = "continue.onnx"


NEEDED = frozenset({GraphFile.DECIDE, GraphFile.FOLLOW, GraphFile.JUDGE})
"""Files that every exported controller has."""


@dataclass(frozen=True, slots=True)
class ControllerQuantity:
    """A state or a control.

    Attributes:
        name: name in the system file.
        unit: unit of its values; "" if dimensionless.
        low: lower end of its range; None without a range. A state may leave its range, which is nominal.
        high: upper end of its range.
        added: "parameter" or "timer" for a state that the specification adds, else "".
        initial: value of a timer at the start of a mission.
    """

    name: str
    unit: str
    low: float | None
    high: float | None
    added: str = ""
    initial: float | None = None


@dataclass(frozen=True, slots=True)
class FeedbackGains:
    """Feedback law around the plans: actuator commands from planned controls v.

    The commands in the state x are clip(u0 + v + clip(K (x0 - x), -a, a), low, high).

    Attributes:
        gain: K, (m, n), without states that the specification adds.
        state: x0, (n,).
        control: u0, (m,).
        low: lower ends of the actuators' ranges, (m,).
        high: upper ends of the actuators' ranges, (m,).
        authority: greatest correction a, (m,).
    """

    gain: Numbers
    state: Numbers
    control: Numbers
    low: Numbers
    high: Numbers
    authority: Numbers

    def __call__(self, x: Numbers, planned: Numbers) -> Numbers:
        """Return actuator commands (rows, m) from states (rows, n) and planned controls (rows, m)."""
        back = (self.state - x[:, : len(self.state)]) @ self.gain.T
        total = self.control + planned + np.clip(back, -self.authority, self.authority)
        return np.clip(total, self.low, self.high)


@dataclass(frozen=True, slots=True)
class Facts:
    """Description of an exported controller.

    Attributes:
        spec: name and hash of the specification.
        system: name and hash of the system.
        states: states in order; those that the specification adds come last.
        controls: controls in order.
        requirements: names of the requirements in order.
        dt: time step in seconds.
        horizon: number of steps of a plan.
        grid: prefixes (first controls of a plan) that the backup policy tries.
        graphs: file name -> content in bytes.
        feedback: feedback law around the plans; None if the actuators get the planned controls.
    """

    spec: Mapping[str, str]
    system: Mapping[str, str]
    states: tuple[ControllerQuantity, ...]
    controls: tuple[ControllerQuantity, ...]
    requirements: tuple[str, ...]
    dt: float
    horizon: int
    grid: PrefixGrid
    graphs: Mapping[str, bytes]
    feedback: FeedbackGains | None = None

    @property
    def added(self) -> tuple[ControllerQuantity, ...]:
        """The states that the specification adds to those of the system: parameters and timers."""
        return tuple(each for each in self.states if each.added)


def read_facts(where: Path | str) -> Facts:
    """Read the description of a controller.

    Args:
        where: folder of the controller, or a file in it.

    Raises:
        UsageError: U102, the folder does not exist.
        RunError: R106, a file is missing, damaged, or of another export.
    """
    path = Path(where)
    if not path.exists():
        raise usage(f"there is no controller `{path}`", code="U102")
    folder = path if path.is_dir() else path.parent
    try:
        return _facts(json.loads(_content(folder / FACTS)), folder)
    except _DAMAGE as error:
        finding = Diagnostic(
            "R106",
            f"`{folder}` holds no whole controller",
            note=(f"{type(error).__name__}: {error}",),
            help=("take all files of one `stlc export RUN --to onnx`",),
        )
        raise RunError(finding) from error


def _facts(read: Mapping[str, Any], folder: Path) -> Facts:
    if read["format"] != FORMAT:
        raise ValueError(f"its format is {read['format']}, not {FORMAT}")
    digests = dict(read["files"])
    if not NEEDED <= digests.keys() <= {*GraphFile}:
        raise ValueError(f"its graphs are {', '.join(digests)}")
    states, controls = (tuple(map(_quantity, read[key])) for key in ("states", "controls"))
    requirements, dt, horizon = tuple(read["requirements"]), float(read["dt"]), int(read["horizon"])
    if not all(isinstance(name, str) for name in requirements):
        raise ValueError("a requirement without a name")
    if not (states and controls and 0.0 < dt < math.inf and 0 < horizon <= MAX_STEPS):
        raise ValueError(f"{len(states)} states, {len(controls)} controls, {horizon} steps of {dt} s")
    return Facts(
        dict(read["spec"]),
        dict(read["system"]),
        states,
        controls,
        requirements,
        dt,
        horizon,
        _grid(read["backup"], len(controls), horizon),
        {name: _whole(folder / name, digest) for name, digest in digests.items()},
        _feedback(read.get("feedback"), len(controls)),
    )


def _quantity(read: Mapping[str, Any]) -> ControllerQuantity:
    found = ControllerQuantity(**read)
    numbers = [value for value in (found.low, found.high, found.initial) if value is not None]
    if not all(isinstance(text, str) for text in (found.name, found.unit, found.added)):
        raise ValueError("a state or a control whose name or unit is no text")
    if any(isinstance(value, bool) or not math.isfinite(value) for value in numbers):
        raise ValueError(f"`{found.name}` has a range that is not finite")
    return found


def _feedback(read: Mapping[str, Any] | None, controls: int) -> FeedbackGains | None:
    if read is None:
        return None
    found = {name: np.array(read[name], dtype=np.float64) for name in FeedbackGains.__annotations__}
    shapes = dict.fromkeys(found, (controls,)) | {"gain": (controls, found["state"].size)}
    if any(
        found[name].shape != shape for name, shape in (shapes | {"state": (found["state"].size,)}).items()
    ):
        raise ValueError(f"a gain of shape {found['gain'].shape}")
    return FeedbackGains(**found)


def _grid(read: Mapping[str, Any], controls: int, horizon: int) -> PrefixGrid:
    if read["sampling"] not in SAMPLINGS:
        raise ValueError(f"there is no sampling {read['sampling']!r}")
    values = tuple(tuple(map(float, each)) for each in read["values"])
    lengths, batch, samples = tuple(map(int, read["lengths"])), int(read["batch"]), int(read["samples"])
    if len(values) != controls or not all(values) or not all(0 < length <= horizon for length in lengths):
        raise ValueError(f"prefixes of {lengths} steps for {len(values)} controls")
    if not (0 < batch <= MAX_PREFIXES and 0 < samples <= MAX_PREFIXES):
        raise ValueError(f"{samples} prefixes in batches of {batch}; at most {MAX_PREFIXES}")
    return PrefixGrid(values, lengths, batch, samples, read["sampling"])


def _content(path: Path) -> bytes:
    if path.exists() and not path.is_file():  # a pipe or a device has no end
        raise ValueError(f"{path.name} is not a file")
    return path.read_bytes()


def _whole(path: Path, digest: str) -> bytes:
    data = _content(path)
    if hashlib.sha256(data).hexdigest() != digest:
        raise ValueError(f"{path.name} is damaged, or of another export")
    return data
